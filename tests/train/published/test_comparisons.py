"""Comparisons: figures of a page by hand from made-up cells, what is missing, and lists that are wrong."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path

import pytest
from msgspec import structs

from marl_sched.errors import InvalidFileError, MarlSchedError
from marl_sched.train.published.by_round import by_round, shown_rounds
from marl_sched.train.published.comparison_page import page
from marl_sched.train.published.comparisons import (
    Cell,
    Comparisons,
    as_comparisons,
    make,
    missing,
    places,
    read_cells,
    write_cells,
)
from marl_sched.train.published.plan import shipped_list

RESULTS = Path(__file__).resolve().parents[3] / "docs" / "results"
COMMAND = "marl-sched tables --env murse"
TINY = {
    "env": "murse",
    "objective": "makespan",
    "seed": 5,
    "comparisons": [
        {
            "title": "Planned",
            "options": {"durations": "deterministic"},
            "horizon": 1,
            "instances": {"small": 4},
            "baseline": "lst",
            "exact": "edf",
            "rows": [
                {"label": "published", "published": {"small": [61.5, 408.76]}},
                {"label": "lst", "scheduler": "lst", "remark": "a rule."},
                {"label": "edf", "scheduler": "edf", "instances": {"small": 2}, "published": {"small": [50, 200]}},
            ],
        }
    ],
}


@pytest.fixture
def plan() -> Comparisons:
    return as_comparisons(deepcopy(TINY), "tiny")


def cells(plan: Comparisons) -> dict[str, Cell]:
    made_up = {
        "lst": ([[100.0], [200.0], [300.0], [400.0]], [[1], [1], [1], [0]]),
        "edf": ([[80.0], [190.0]], [[1], [0]]),
    }
    found = {}
    for place in places(plan):
        objective, feasible = made_up[place.entry.label]
        found[place.inputs.name] = Cell(
            inputs=place.inputs, objective=objective, feasible=feasible, visible_share=1.0, privileged_info=[],
            cpu_seconds=0.02, revision="0123456789abcdef",
        )  # fmt: skip
    return found


def test_the_pages_figures_by_hand(plan):
    """lst: 3 of 4 feasible, mean 250, 100 / 80 over the one round that is feasible for both, 5 ms a round.

    edf on the first two instances: 80 - 100 and 190 - 200, mean -15 of 150, Student's t of one degree of freedom at
    97.5 percent is 12.706 and the standard error 5: 42.35 percent of 150 to either side.
    """
    told = page(plan, cells(plan), COMMAND)
    assert "| published | *61.5* | *408.76* | - | - | - |" in told
    assert "| lst | 75.0 | 250.0 | 1.250 | - | 5 |" in told
    assert "| edf (2 instances) | 50.0 *50* | 135.0 *200* | 1.000 | -10.0 [-52.4, +32.4] | 10 |" in told
    assert "- lst: a rule." in told
    assert "`0123456789ab` (2)" in told


def test_share_solved_within_a_ratio_counts_what_the_exact_row_did_not_find():
    """lst is at 100 / 80 = 1.25 in the first round and alone in the second; the others of lst edf has not played."""
    given = deepcopy(TINY)
    given["comparisons"][0] |= {"within": [1.2, 1.25]}
    given["comparisons"][0]["rows"][0]["published"] = {"small": [61.5]}
    plan = as_comparisons(given, "tiny")
    told = page(plan, cells(plan), COMMAND)
    assert "| scheduler | feasible % | makespan | over edf | within 1.2 | within 1.25 | difference to lst % |" in told
    assert "| lst | 75.0 | 250.0 | 1.250 | 50 | 100 | - | 5 |" in told
    assert "| 1.000 | 50 | 50 | -10.0" in told
    assert "| published | *61.5* | - | - | - | - | - | - |" in told


def test_missing_cells_are_named_with_the_command_and_made(plan, tmp_path: Path):
    with pytest.raises(MarlSchedError, match="2 cells are missing, lst on small of 'Planned' among them: `marl-sched"):
        page(plan, {}, COMMAND)
    (lst, edf) = missing(places(plan), {})
    made = {place.inputs.name: make(place.inputs) for place in (lst, edf)}
    write_cells(tmp_path / "cells.jsonl", made)
    again = read_cells(tmp_path / "cells.jsonl")
    assert again == made
    assert [len(again[place.inputs.name].objective) for place in (lst, edf)] == [4, 2]
    assert not missing(places(plan), again)
    (tmp_path / "cells.jsonl").write_text("{}\n")
    with pytest.raises(InvalidFileError, match="line 1"):
        read_cells(tmp_path / "cells.jsonl")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"baseline": "nobody"}, "unknown row of 'Planned'"),
        ({"instances": {"tiny": 2}}, "tiny"),
        ({"options": {"speed": 2}}, "speed"),
        ({"surplus": 1}, "surplus"),
        ({"exact": None, "within": [1.1]}, "within"),
    ],
)
def test_a_list_that_is_wrong_is_refused(change, message):
    given = deepcopy(TINY)
    given["comparisons"][0] |= change
    with pytest.raises(InvalidFileError, match=message):
        as_comparisons(given, "tiny")


@pytest.mark.parametrize("path", sorted(RESULTS.glob("murse.md")), ids=lambda path: path.stem)
def test_the_committed_page_is_what_the_committed_cells_give(path: Path):
    plan = as_comparisons(*shipped_list(path.stem))
    told = page(plan, read_cells(RESULTS / path.stem / "cells.jsonl"), COMMAND)
    assert told == path.read_text(encoding="utf-8"), "draw it again: make tables-murse"


def test_rounds_of_an_episode_are_told_apart_and_short_instances_count_only_where_they_have_a_round(plan):
    """Of two instances the second has one round: 1 of 2 feasible and mean 150 in the first, 90 in the second."""
    cell = next(iter(cells(plan).values()))
    played = structs.replace(cell, objective=[[100.0, 90.0], [200.0]], feasible=[[1, 1], [0]])
    assert by_round({"lst": played}) == (["scheduler", "round 1", "round 2"], [["lst", "50 % 150", "100 % 90"]])
    assert shown_rounds(10) == [0, 2, 4, 7, 9]
    assert shown_rounds(1) == [0]
