"""Commands that end well."""

import json
import subprocess
import sys

import numpy as np
import pytest

from marl_sched.agents.airme.schedulers import RULES
from marl_sched.cli import app
from marl_sched.cli.app import app as application
from marl_sched.domain import get_domain

COMMANDS = [
    "generate", "template", "import", "fit", "advise", "schedule", "validate", "evaluate", "compare", "bench", "tables",
    "bound", "train", "resume", "export", "export-onnx", "curves", "world", "router", "agent", "deploy", "replay",
    "certs", "chaos", "order", "watch", "demo", "list", "doctor",
]  # fmt: skip
AIRME = get_domain("airme")
SHORT = ("--instances", 2, "--episodes", 2, "--hours", 24, "--seed", 3)


def without_seconds(results):
    for row in results["schedulers"].values():
        del row["seconds"]
    return results


def test_the_commands_have_the_names_that_other_tools_call():
    names = [command.name or command.callback.__name__ for command in application.registered_commands]
    assert sorted(names) == sorted(COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_every_command_shows_an_example(run, command):
    ended = run(command, "--help")
    assert ended.code == 0
    assert f"Example: marl-sched {command}" in " ".join(ended.out.split())


def test_without_a_command_the_commands_are_listed(run):
    ended = run()
    assert ended.code == 0
    assert all(command in ended.out for command in COMMANDS)


def test_version_is_that_of_the_installed_package(run):
    from importlib.metadata import version

    assert run("--version").out == f"marl-sched {version('marl-sched')}\n"


def test_list_names_environments_schedulers_and_views(run):
    out = run("list").out
    assert "airme" in out
    assert "murse" in out
    assert all(rule in out for rule in RULES)
    assert "local(reach=1, comm=1, staleness=0)" in out


def test_list_and_help_load_neither_torch_nor_zenoh_nor_matplotlib_nor_scipy():
    script = (
        "import sys; from marl_sched.cli.app import run\n"
        "run(['list']); run(['deploy', '--help']); run(['train', '-h'])\n"
        "heavy = {'torch', 'zenoh', 'matplotlib', 'hydra', 'ortools', 'scipy.stats'}\n"
        "print(sorted(heavy & set(sys.modules)), file=sys.stderr)"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ended.stderr == "[]\n"


def test_the_module_runs_like_the_script():
    command = [sys.executable, "-m", "marl_sched.cli", "evaluate", "--schedulers", "nobody"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert ended.stderr.startswith("error: unknown scheduler 'nobody'")
    assert ended.stdout == ""


def test_doctor_tells_versions_threads_gpu_and_zenoh(run):
    out = run("doctor").out
    assert f"numpy          {np.__version__}" in out
    assert "python         " + sys.version.split()[0] in out
    for topic in ("torch threads", "gpu", "zenoh          a session opens"):
        assert topic in out


def test_doctor_says_how_to_get_what_is_missing(run, monkeypatch):
    from marl_sched.cli import information

    monkeypatch.setitem(information.DISTRIBUTIONS, "no-such-distribution", "solvers")
    out = run("doctor").out
    assert "no-such-distribution missing; pip install 'marl-sched[solvers]'" in out
    assert out.endswith("missing extras: solvers\n")


def test_generated_files_hold_the_instances_of_the_seed(run, tmp_path):
    assert run("generate", "airme", "--scale", "medium", "--count", 2, "--seed", 5, "--out", tmp_path / "p").code == 0
    paths = sorted((tmp_path / "p").iterdir())
    assert [path.name for path in paths] == ["airme-medium-5-0000.json", "airme-medium-5-0001.json"]
    expected = [instance.identity for instance in AIRME.instances("medium", 2, 5)]
    assert [AIRME.load(path).identity for path in paths] == expected


def test_an_instance_does_not_depend_on_how_many_are_drawn(run, tmp_path):
    run("generate", "airme", "--count", 1, "--seed", 5, "--out", tmp_path / "one")
    run("generate", "airme", "--count", 12, "--seed", 5, "--out", tmp_path / "many")
    first = (tmp_path / "one" / "airme-small-5-0000.json").read_bytes()
    assert (tmp_path / "many" / "airme-small-5-0000.json").read_bytes() == first


def test_evaluate_writes_the_same_results_for_the_same_seed(run, tmp_path):
    results = []
    for name in ("a", "b"):
        ended = run("evaluate", "--schedulers", "random,condition", *SHORT, "--json", tmp_path / name)
        assert ended.code == 0
        assert "condition" in ended.out
        results.append(without_seconds(json.loads((tmp_path / name).read_text())))
    assert results[0] == results[1]
    assert list(results[0]["schedulers"]) == ["random", "condition"]


def test_instances_from_files_score_like_the_same_ones_generated(run, tmp_path):
    run("generate", "airme", "--count", 2, "--seed", 3, "--out", tmp_path / "p")
    same = ("--schedulers", "preventive-first", "--episodes", 2, "--hours", 24, "--seed", 3, "--json")
    run("evaluate", "--instances", tmp_path / "p", *same, tmp_path / "files.json")
    run("evaluate", "--instances", 2, *same, tmp_path / "drawn.json")
    files, drawn = (without_seconds(json.loads((tmp_path / f"{n}.json").read_text())) for n in ("files", "drawn"))
    assert files["schedulers"] == drawn["schedulers"]
    assert (files["scale"], drawn["scale"]) == (None, "small")


def test_the_options_of_the_view_reach_the_simulator(run, tmp_path):
    view = ("--view", "local", "--reach", 0, "--comm", 2, "--staleness", 4)
    run("evaluate", "--schedulers", "condition", *SHORT, *view, "--json", tmp_path / "r.json")
    seen = json.loads((tmp_path / "r.json").read_text())["view"]
    share, local = seen.pop("visible_share"), seen.pop("local")
    assert local
    assert seen == {"kind": "local", "reach": 0, "comm": 2, "staleness": 4}
    assert 1 / 8 - 0.03 < share < 1 / 6 + 0.03  # one sector of six to eight


def test_the_objective_and_the_baseline_are_taken(run, tmp_path):
    chosen = ("--objective", "revenue", "--baseline", "random", "--failure", "hazard")
    run("evaluate", "--schedulers", "random,condition", *SHORT, *chosen, "--json", tmp_path / "r.json")
    results = json.loads((tmp_path / "r.json").read_text())
    assert (results["objective"], results["baseline"], results["options"]) == (
        "revenue",
        {"scheduler": "random", "view": {"kind": "full"}},
        {"failure": "hazard"},
    )
    assert results["schedulers"]["random"]["difference"]["mean"] == 0
    assert results["schedulers"]["condition"]["difference"]["to"] == "random"


def test_the_table_keeps_names_whole_on_a_narrow_terminal(run, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    out = run("evaluate", "--schedulers", "corrective-published,preventive-first", *SHORT).out
    assert "corrective-published " in out
    assert max(len(line) for line in out.splitlines()) <= 80
    assert "difference: paired, to corrective-published with the full view" in " ".join(out.split())


def test_a_local_view_that_shows_too_much_is_marked(run, tmp_path):
    arguments = ("evaluate", "--schedulers", "condition", *SHORT, "--view", "local", "--reach")
    far = run(*arguments, 2, "--json", tmp_path / "far.json")
    near = run(*arguments, 0, "--json", tmp_path / "near.json")
    for ended, name, local in ((far, "far", False), (near, "near", True)):
        results = json.loads((tmp_path / f"{name}.json").read_text())
        row = results["schedulers"]["condition"]
        assert results["view"]["local"] is row["local"] is local is (row["visible_share"] <= 0.45)
        assert ("not local)" in ended.out) is not local
        assert ("too much to be local" in " ".join(ended.out.split())) is not local


def test_compare_writes_results_and_pictures(run, tmp_path):
    log = tmp_path / "my-run" / "progress.csv"
    log.parent.mkdir()
    log.write_text("update,seconds,validation\n1,60,0.5\n2,90,\n3,120,0.6\n")
    ended = run("compare", "--schedulers", "random,condition", *SHORT, "--out", tmp_path / "out", "--log", log)
    assert ended.code == 0
    written = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert written == ["learning.png", "results.json", "scores.png", "timelines.png"]
    for name in written:
        assert str(tmp_path / "out" / name) in ended.out.replace("\n", "")
        if name.endswith(".png"):
            assert (tmp_path / "out" / name).read_bytes().startswith(b"\x89PNG")


def test_an_interrupted_command_ends_with_130(run, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("marl_sched.domain.get_domain", interrupt)
    ended = run("evaluate", "--schedulers", "condition")
    assert (ended.code, ended.err) == (130, "interrupted\n")


def test_a_defect_keeps_its_traceback(monkeypatch):
    def fail(*_, **__):
        raise ZeroDivisionError

    monkeypatch.setattr("marl_sched.domain.get_domain", fail)
    with pytest.raises(ZeroDivisionError):
        app.run(["evaluate", "--schedulers", "condition"])


def test_a_policy_that_plays_what_it_was_not_trained_for_is_told_once_and_only_then(run):
    few = ("--instances", "1", "--episodes", "1", "--hours", "3", "--schedulers")
    done = run("evaluate", *few, "airme-local-profit,condition", "--objective", "revenue")
    assert done.err.splitlines() == [
        "note: airme-local-profit was trained for view local (reach 1, comm 1, staleness 0), it plays with full",
        "note: airme-local-profit was trained for profit, it plays for revenue",
    ]
    assert run("evaluate", *few, "airme-local-profit,airme-any-profit", "--view", "local").err == ""
