"""The page: figures worked out by hand from made-up cells, and drawn from cells alone."""

import json
import shlex
from pathlib import Path

import pytest
from scipy import stats

from marl_sched.errors import InvalidFileError, MarlSchedError
from marl_sched.train.config import load_config
from marl_sched.train.published.entries import Entries
from marl_sched.train.published.page import page, write_pages
from marl_sched.train.published.plan import as_plan, shipped_list
from marl_sched.train.published.results import Results
from marl_sched.train.published.store import Cells

ROOT = Path(__file__).resolve().parents[3]
RESULTS = ROOT / "docs" / "results"
METHODS = [
    "Random", "Corrective", "Condition-based", "Periodic", "Model-based",
    "DeepRM", "Decima", "HetGPO-Single", "HetGPO-Skip", "HetGPO-Full",
]  # fmt: skip


@pytest.fixture
def results(entries, cells, trained, write):
    write(entries, cells)
    return Results(entries, cells, "marl-sched tables --env airme").as_json()


def row(results, label, objective="profit"):
    return next(row for row in results["objectives"][objective]["rows"] if row["label"] == label)


def test_measures_are_those_worked_out_by_hand(results):
    figures = row(results, "Condition-based")["scales"]["small"]
    assert figures["M1"]["mean"] == pytest.approx(0.6)  # of 0.5 and 0.7
    assert figures["M1"]["std"] == pytest.approx(0.1)
    assert figures["M2"]["mean"] == pytest.approx(32.5)  # 0.5 over 0.4, 0.7 over 0.5: 25 and 40 percent
    assert figures["M2"]["std"] == pytest.approx(7.5)
    assert figures["gap_closed"] == pytest.approx(100 * (0.6 - 0.45) / (0.85 - 0.45))
    assert figures["published"] == {"m1": 0.4, "m1_std": 0.03, "m2": -20.0, "m2_std": 1.25}


def test_differences_are_to_the_best_rule_that_does_not_know_the_failure_model(results):
    assert results["objectives"]["profit"]["scales"]["small"]["best_rule"] == "Condition-based"
    difference = row(results, "net")["scales"]["small"]["difference"]
    assert difference["mean"] == pytest.approx(0.15)  # 0.2 and 0.1
    reach = stats.t.ppf(0.975, 1) * 0.05  # standard error of two numbers 0.1 apart
    assert difference["ci95_such_instances"] == pytest.approx([0.15 - reach, 0.15 + reach], abs=1e-6)


def test_an_order_is_contradicted_only_by_more_than_chance(entries, cells, trained, write, plan):
    import msgspec

    write(entries, cells)
    shown = Results(entries, cells, "").as_json()["objectives"]["profit"]["contradictions"]
    assert shown == []  # 0.1 and 0.2 more: two instances are too few for that

    inputs = entries.row(plan.rows[1], "profit", "small").inputs
    cells.write(msgspec.structs.replace(cells.read(inputs), M1=[0.5, 0.601]))  # 0.1 and 0.101 more
    (shown,) = Results(entries, cells, "").as_json()["objectives"]["profit"]["contradictions"]
    assert (shown["lower"], shown["higher"], list(shown["scales"])) == ("Corrective", "Condition-based", ["small"])


def test_a_view_costs_what_it_takes_from_the_same_scheduler_with_the_full_one(entries, cells, trained, write, plan):
    import msgspec

    write(entries, cells)
    inputs = entries.point(plan.decentralisation.lines[0], "near", "small").inputs
    cells.write(msgspec.structs.replace(cells.read(inputs), M1=[0.45, 0.6]))
    small = Results(entries, cells, "").as_json()["decentralisation"]["scales"]["small"]
    line, learned = small["lines"]
    assert line["points"]["near"]["cost"]["mean"] == pytest.approx(-0.075)
    assert line["points"]["everything"]["cost"]["mean"] == 0.0
    assert list(learned["points"]) == ["near"]
    assert "cost" not in learned["points"]["near"]
    assert small["central"] == {"M1": pytest.approx(0.6), "label": "condition"}
    assert small["bound"] == pytest.approx(0.85)


def test_the_page_shows_published_values_what_is_known_and_what_is_missing(results):
    text = page(results)
    lines = text.splitlines()
    shown = next(line for line in lines if line.startswith("| Condition-based"))
    assert "0.600 ± 0.100<br>*0.400 ± 0.030* | 32.5 ± 7.50<br>*-20.0 ± 1.25*" in shown
    assert any(line.startswith("| `knowing`<br>`model-based` | everything | failure model |") for line in lines)
    assert any(line.startswith("| Condition-based<br>`condition` | everything | nothing |") for line in lines)
    net = [line for line in lines if line.startswith("| net<br>(scheme skip)")]
    assert "local (1, 1, 0): 40 %" in net[1]
    assert "not trained yet" in net[2]  # the table of revenue
    assert (
        "`marl-sched train view=local`, seed 3, view local (1, 1, 0), plays greedily. Training used a teacher." in text
    )
    assert (
        "- `policies/net-revenue.safetensors` (net): `marl-sched train env.objective=revenue`"
        in text.split("## Not")[1]
    )


def test_a_remark_of_the_list_stands_below_the_tables(tiny, cells, trained, write, tmp_path):
    tiny["rows"][1]["remark"] = "serves by hours alone"
    plan = as_plan(tiny, "tiny.yaml")
    entries = Entries(plan, plan.full, tmp_path)
    write(entries, cells)
    assert "## Remarks\n\n- Condition-based: serves by hours alone\n" in page(Results(entries, cells, "").as_json())


@pytest.mark.parametrize("episodes", [{}, {"small": 1}])
def test_rows_that_played_fewer_episodes_are_explained_where_there_are_any(
    tiny, cells, trained, write, tmp_path, episodes
):
    tiny["rows"][1]["episodes"] = episodes
    plan = as_plan(tiny, "tiny.yaml")
    entries = Entries(plan, plan.full, tmp_path)
    write(entries, cells)
    text = page(Results(entries, cells, "").as_json())
    assert ("rows that say that they played fewer episodes" in text) == bool(episodes)
    assert ("episodes: 1 on small" in text) == bool(episodes)


def test_a_row_may_decide_otherwise_than_its_policys_card_says(tiny, cells, trained, write, tmp_path):
    tiny["rows"][-1]["mode"] = "one_pass"
    plan = as_plan(tiny, "tiny.yaml")
    entries = Entries(plan, plan.full, tmp_path)
    assert entries.row(plan.rows[-1], "profit", "small").inputs.mode == "one_pass"
    write(entries, cells)
    text = page(Results(entries, cells, "").as_json())
    assert "plays by sampling for all who decide at a decision epoch from one forward pass" in text


def test_a_view_that_shows_too_much_is_not_called_local(entries, cells, trained, write, plan):
    import msgspec

    write(entries, cells)
    inputs = entries.row(plan.rows[-1], "profit", "small").inputs
    cells.write(msgspec.structs.replace(cells.read(inputs), visible_share=0.46))
    assert "46 %; too much to be called local" in page(Results(entries, cells, "").as_json())


def test_drawing_the_page_again_gives_the_same_bytes(entries, cells, trained, write, tmp_path):
    write(entries, cells)
    drawn = []
    for name in ("one", "other"):
        folder = tmp_path / name
        assert all(path.exists() for path in write_pages(entries, cells, "marl-sched tables", folder))
        drawn.append({path.name: path.read_bytes() for path in folder.iterdir()})
    assert drawn[0] == drawn[1]
    assert sorted(drawn[0]) == ["airme.json", "airme.md", "price-of-decentralisation.png"]
    assert page(json.loads(drawn[0]["airme.json"])).encode() == drawn[0]["airme.md"]


def test_a_quick_page_says_so(plan, cells, trained, write, tmp_path):
    entries = Entries(plan, plan.quick, tmp_path)
    write(entries, cells)
    assert "**Quick look:**" in page(Results(entries, cells, "").as_json())


def test_a_missing_cell_is_named_with_the_command_and_nothing_is_written(entries, cells, write, tmp_path):
    write(entries, cells)
    cells.remove(entries.all()[0][0].inputs)
    with pytest.raises(MarlSchedError, match="make what is missing with `marl-sched tables --env airme`") as told:
        write_pages(entries, cells, "marl-sched tables --env airme", tmp_path / "page")
    assert str(cells.path) in str(told.value)
    assert not (tmp_path / "page").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"surplus": 1}, "tiny.yaml: expected a list of tables .*surplus"),
        ({"seed": -1}, r"tiny.yaml: seed: expected"),
        ({"scales": ["tiny"]}, "unknown scale"),
        ({"rows": [{"label": "a", "group": "ours", "rule": "nobody"}]}, "unknown rule of 'a' 'nobody'"),
        (
            {"rows": [{"label": "a", "group": "ours", "rule": "random", "episodes": {"large": 1}}]},
            "unknown scale of these tables 'large'",
        ),
        ({"rows": [{"label": "a", "group": "ours"}]}, "'a': expected exactly one of rule, policy"),
        ({"rows": [{"label": "a", "group": "ours", "rule": "random"}] * 2}, "expected distinct labels"),
        ({"rows": [{"label": "a", "group": "ours", "rule": "random", "mode": "sample"}]}, "mode of 'a': expected none"),
        (
            {"rows": [{"label": "a", "group": "ours", "rule": "random"}]},
            "expected one of the rule corrective-published",
        ),
    ],
)
def test_a_list_that_is_wrong_is_refused_in_one_line(tiny, change, message):
    with pytest.raises(InvalidFileError, match=message) as refused:
        as_plan({**tiny, **change}, "tiny.yaml")
    assert "\n" not in str(refused.value)


def test_the_list_that_ships_has_every_method_of_the_dissertation_in_every_table():
    plan = as_plan(*shipped_list("airme"))
    published = {row.label: row.published for row in plan.rows if row.group == "published"}
    assert list(published) == METHODS
    for entries in published.values():
        assert list(entries) == ["profit", "revenue", "availability"]
        assert all(list(scales) == ["small", "medium", "large"] for scales in entries.values())
    best = published["HetGPO-Skip"]["profit"]["medium"]
    assert (best.m1, best.m1_std, best.m2, best.m2_std) == (0.697, 0.009, 27.5, 2.70)
    worst = published["Periodic"]["availability"]["large"]
    assert (worst.m1, worst.m1_std, worst.m2, worst.m2_std) == (0.725, 0.081, -0.67, 7.33)


def test_the_list_that_ships_names_no_place_outside_the_repository():
    plan = as_plan(*shipped_list("airme"))
    policies = [player.policy for player in [*plan.rows, *plan.decentralisation.lines] if player.policy]
    assert policies
    assert not [policy for policy in policies if policy.startswith(("/", "~")) or ".." in policy]


def test_every_command_of_the_list_that_ships_is_one_that_trains():
    plan = as_plan(*shipped_list("airme"))
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    asked = [
        (row.command.replace("{objective}", objective).replace("{scale}", scale), objective)
        for row in plan.rows
        if row.policy is not None
        for objective in plan.objectives
        for scale in plan.scales
        if row.plays(objective, scale)
    ]
    asked += [(line.command, plan.decentralisation.objective) for line in plan.decentralisation.lines if line.policy]
    assert asked
    for command, objective in dict.fromkeys(asked):
        match shlex.split(command):
            case ["marl-sched", "train", *overrides]:
                assert load_config(overrides).env.objective == objective
            case ["make", action]:
                name = action.removeprefix("policy-")
                assert f"\nTRAIN_{name} := " in makefile or f"\npolicy-{name}: " in makefile, command
            case _:
                pytest.fail(f"no way to train a policy: {command!r}")


@pytest.mark.parametrize("path", sorted(RESULTS.glob("airme.md")), ids=lambda path: path.stem)
def test_the_committed_page_is_what_the_committed_cells_give(path, tmp_path):
    plan = as_plan(*shipped_list(path.stem))
    entries = Entries(plan, plan.full, ROOT)
    command = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))["command"]
    write_pages(entries, Cells(RESULTS / path.stem / "cells.jsonl"), command, tmp_path)
    for name in (f"{path.stem}.json", f"{path.stem}.md"):
        assert (tmp_path / name).read_bytes() == (RESULTS / name).read_bytes(), f"{name}: draw it again"
