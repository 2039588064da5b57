"""MuRSE on the command line: solvable problems, schedulers side by side, speed."""

import json
from dataclasses import replace

import numpy as np

from marl_sched.agents.murse.exact import solve
from marl_sched.agents.murse.problem import Round
from marl_sched.domain import get_domain
from marl_sched.envs.murse.reading import load
from marl_sched.envs.murse.validation import validate
from marl_sched.train import bench


def test_feasible_problems_are_generated_on_demand(run, tmp_path):
    assert run("generate", "murse", "--count", 2, "--seed", 3, "--feasible", "--out", tmp_path).code == 0
    paths = sorted(tmp_path.glob("*.json"))
    assert len(paths) == 2
    assert all(solve(Round.of(load(path))).plan is not None for path in paths)


def test_domains_without_infeasible_problems_say_so(run, tmp_path):
    ended = run("generate", "airme", "--feasible", "--out", tmp_path)
    assert ended.code == 2
    assert "--feasible: the environment 'airme' has no infeasible instances" in ended.err


def test_evaluation_tells_every_measure_of_every_round(run, tmp_path):
    options = ("--env", "murse", "--scale", "small", "--rounds", 3, "--mode", "online", "--durations", "stochastic")
    names = "edf-published,cbba,first-claim,exact"
    view = ("--view", "local", "--comm", 0, "--sensing", 9, "--proximity", "none")
    out = tmp_path / "r.json"
    ended = run("evaluate", *options, *view, "--instances", 2, "--episodes", 1, "--schedulers", names, "--json", out)
    assert ended.code == 0, ended.err
    rows = json.loads(out.read_text())["schedulers"]
    assert list(rows) == names.split(",")
    for row in rows.values():
        for measure in ("feasible", "makespan", "makespan_feasible", "conflicts"):
            assert len(row[measure]["per_round"]) == 3
        assert 0.0 <= row["feasible"]["mean"] <= 1.0
        assert "mean" in row["gap_to_exact"]
    for name in ("cbba", "first-claim"):
        assert all(count > 0 for measure in ("messages", "bytes") for count in rows[name][measure]["per_round"])
    assert rows["cbba"]["conflicts"]["mean"] > 0  # nobody hears anybody
    assert rows["exact"]["conflicts"]["mean"] == 0


def test_the_bench_measures_schedules_and_edf(run, tmp_path, monkeypatch):
    for name, value in (("BATCH", 3), ("_AEC_TURNS", 20), ("_TORCHRL_STEPS", 2), ("_POLICY_DECISIONS", 2)):
        monkeypatch.setattr(bench, name, value)
    assert run("bench", "--env", "murse", "--repeats", 1, "--json", tmp_path / "b.json").code == 0
    figures = bench.read_bench(tmp_path / "b.json").figures
    assert {"schedule_us_b3", "edf_large_ms", "aec_turns_per_s", "torchrl_decisions_per_s"} < set(figures)


def test_a_hopeless_instance_is_told_in_one_line_on_stderr(run, tmp_path):
    solvable = get_domain("murse").instances("small", 1, 0)[0]
    solvable.save(tmp_path / "a.json")
    replace(solvable, deadlines=np.ones_like(solvable.deadlines)).save(tmp_path / "b.json")
    ended = run(
        "evaluate", "--env", "murse", "--rounds", 1, "--instances", tmp_path, "--episodes", 1, "--schedulers", "edf"
    )
    assert ended.code == 0
    assert ended.err.count("\n") == 1
    assert ended.err.startswith(f"warning: {tmp_path / 'b.json'}: no schedule can be feasible: task 1: deadline 1 but")


def test_files_of_all_formats_are_evaluated_with_a_row_for_each_and_their_schedules_confirmed(run, tmp_path):
    shops, out, kept = tmp_path / "shops", tmp_path / "r.json", tmp_path / "kept"
    shops.mkdir()
    (shops / "flow").write_text("2 2\n0 3 1 2\n0 4 1 0\n")  # machine 1: 3 + 4, then machine 2 needs 0: 7 in all
    (shops / "mini.fjs").write_text("2 3 2\n2 2 1 5 3 4 1 2 1\n1 1 3 6\n")
    get_domain("murse").instances("small", 1, 0)[0].save(shops / "ours.json")
    (shops / "README.md").write_text("not an instance")
    words = ("--schedulers", "spt,lst-search@evaluations=8,exact", "--time-limit", 30, "--json", out)
    ended = run(
        "evaluate", "--env", "murse", "--instances", shops, "--rounds", 1, "--episodes", 1, *words,
        "--save-schedules", kept,
    )  # fmt: skip
    assert ended.code == 0, ended.err
    results = json.loads(out.read_text())
    rows = results["by_instance"]
    assert [row["file"] for row in rows] == [str(shops / name) for name in ("flow", "mini.fjs", "ours.json")]
    exact = [row["schedulers"]["exact"] for row in rows]
    assert [one["status"] for one in exact] == ["optimal"] * 3
    assert (exact[0]["objective"], exact[0]["bound"], exact[0]["gap_to_bound"]) == (7.0, 7.0, 0.0)
    assert all(
        row["schedulers"]["lst-search@evaluations=8"]["objective"] >= row["schedulers"]["exact"]["bound"]
        for row in rows
    )
    assert results["schedulers"]["exact"]["gap_to_exact"]["mean"] == 0.0
    files = sorted(kept.rglob("*.json"))
    assert len(files) == 3 * 3
    assert all(
        validate(json.loads(path.read_text())).feasible == json.loads(path.read_text())["feasible"] for path in files
    )
    assert (kept / "spt" / "flow-episode0-round0.json").exists()


def test_a_time_limit_without_a_solver_and_unknown_options_of_schedulers_are_refused(run):
    selection = ("evaluate", "--env", "murse", "--instances", 1, "--schedulers")
    ended = run(*selection, "spt", "--time-limit", 1)
    assert (ended.code, "--time-limit: none of spt has a limit" in ended.err) == (2, True)
    ended = run(*selection, "lst-search@evaluatons=3")
    assert (ended.code, "did you mean 'evaluations'" in ended.err) == (2, True)


def test_the_table_begins_with_feasibility_and_says_what_its_makespan_is(run, monkeypatch):
    monkeypatch.setenv("COLUMNS", "140")
    words = ("--env", "murse", "--instances", 1, "--episodes", 1, "--rounds", 1, "--schedulers", "lst")
    lines = run("evaluate", *words).out.splitlines()
    assert "M1 is mean makespan, infeasible rounds at their worst case over 1 rounds; lower is better" in lines[0]
    headings = next(line for line in lines if "IQM" in line).split()
    assert headings[:4] == ["scheduler", "feasible", "makespan_feasible", "M1"]


def test_more_rounds_than_the_instances_have_are_refused(run, tmp_path):
    (tmp_path / "shop.jsp").write_text("1 1\n0 3\n")
    words = ("--env", "murse", "--instances", tmp_path / "shop.jsp", "--episodes", 1, "--schedulers", "lst")
    ended = run("evaluate", *words, "--rounds", 2)
    assert (ended.code, ended.err) == (2, "error: --rounds 2: the instances have 1 rounds at most\n")
