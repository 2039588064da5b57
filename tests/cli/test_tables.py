"""`marl-sched tables`: cells once, then a page; what is missing is told."""

import sys

import pytest

from marl_sched.cli import pages
from marl_sched.train.published import plan as plans

SIZE = {"instances": 2, "episodes": 1, "bound": {"price_vectors": 1, "evaluations": 1}}
TINY = {
    "env": "airme",
    "scales": ["small"],
    "objectives": ["profit"],
    "full": SIZE,
    "quick": SIZE,
    "seed": 5,
    "horizon": 4,
    "rows": [{"label": "Corrective", "group": "published", "rule": "corrective-published"}],
    "decentralisation": {
        "objective": "profit",
        "scales": ["small"],
        "views": {"near": {"kind": "local", "reach": 0}, "everything": {"kind": "full"}},
        "lines": [{"label": "condition", "rule": "condition"}],
    },
}
LEARNED = {"label": "net", "group": "ours", "policy": "policies/net.safetensors", "command": "marl-sched train seed=7"}


@pytest.fixture
def listed(monkeypatch):
    """Replace the list that ships: `listed(rows...)` adds rows to the tiny one."""

    def listed(*rows):
        given = {**TINY, "rows": [*TINY["rows"], *rows]}
        monkeypatch.setattr(plans, "shipped_list", lambda env: (given, "tiny.yaml"))

    return listed


@pytest.mark.slow
def test_cells_are_made_once_and_the_page_is_drawn_from_them(run, tmp_path, listed):
    listed()
    first = run("tables", "--workers", 2, "--out", tmp_path)
    assert first.code == 0
    assert "4/4" in first.err
    cells = tmp_path / "airme" / "cells.jsonl"
    made = cells.stat().st_mtime_ns
    assert len(cells.read_bytes().splitlines()) == 4  # the bound, corrective, condition under two views
    page = (tmp_path / "airme.md").read_bytes()
    assert (tmp_path / "price-of-decentralisation.png").read_bytes().startswith(b"\x89PNG")

    again = run("tables", "--out", tmp_path)
    assert (again.code, again.err) == (0, "")
    assert cells.stat().st_mtime_ns == made
    assert (tmp_path / "airme.md").read_bytes() == page


@pytest.mark.slow
def test_policies_that_are_not_trained_are_told_on_the_page_and_by_the_exit_code(run, tmp_path, listed):
    listed(LEARNED)
    ended = run("tables", "--out", tmp_path)
    assert ended.code == pages.UNTRAINED == 3
    assert ended.err.endswith("not trained yet: policies/net.safetensors (net): marl-sched train seed=7\n")
    assert "- `policies/net.safetensors` (net): `marl-sched train seed=7`" in (tmp_path / "airme.md").read_text()


def test_drawing_plays_nothing_and_names_the_command_where_a_cell_is_missing(run, tmp_path, listed, monkeypatch):
    listed()
    monkeypatch.setattr(pages, "_fill", lambda *_: sys.exit("played"))
    ended = run("tables", "--render", "--out", tmp_path / "out")
    assert ended.code == 2
    assert ended.err.startswith(f"error: {tmp_path / 'out' / 'airme'}")
    assert "make what is missing with `marl-sched tables --env airme`" in ended.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--env", "ward"), "there are no published tables of the environment 'ward'"),
        (("--env", "airma"), "unknown environment 'airma'"),
        (("--out", __file__), "is not a folder"),
        (("--workers", 0), "--workers"),
        (("--render", "--without-policies"), "expected one of them"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line(run, arguments, message):
    ended = run("tables", *arguments)
    assert ended.code == 2
    assert message in ended.err
