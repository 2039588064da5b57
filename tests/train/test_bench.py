"""The bench: what it hands out, not how fast the machine is."""

import numpy as np
import pytest
import torch

from marl_sched.agents.airme.bench import play_hours, prepared_hours
from marl_sched.domain import get_domain
from marl_sched.errors import InvalidOptionError
from marl_sched.train import bench

AIRME = get_domain("airme")


@pytest.fixture
def _small(monkeypatch):
    monkeypatch.setattr(bench, "BATCH", 3)
    monkeypatch.setattr(bench, "_AEC_TURNS", 20)
    monkeypatch.setattr(bench, "_TORCHRL_STEPS", 2)
    monkeypatch.setattr(bench, "_POLICY_DECISIONS", 2)


@pytest.mark.usefixtures("_small")
def test_the_figures_have_the_names_that_other_tools_read_and_say_what_they_are_of():
    threads = torch.get_num_threads()
    figures = bench.bench(AIRME, repeats=1)
    names = {"hour_us_b1", "hour_us_b3", "aec_turns_per_s", "torchrl_decisions_per_s", "policy_ms"}
    names |= {f"condition_hour_us_{planes}_planes_b{rows}" for planes in (30, 60, 120) for rows in (1, 3)}
    assert set(figures) == names | {"schema", "env", "threads", "repeats", "batch", "statistic", "meaning"}
    assert set(figures["policy_ms"]) == {"small", "large"}
    assert set(figures["meaning"]) == names
    assert all(value > 0 for value in (*figures["policy_ms"].values(), *(figures[n] for n in names - {"policy_ms"})))
    assert figures["threads"] == 1
    assert torch.get_num_threads() == threads


def test_the_prepared_hours_replay_the_rules_own_episode():
    simulator, choices = prepared_hours(AIRME, 2)
    expected = simulator.objectives()["profit"].copy()
    simulator.reset(seed=0)
    play_hours(simulator, choices)
    np.testing.assert_array_equal(simulator.objectives()["profit"], expected)
    assert simulator.over.all()


def test_no_repeats_are_refused():
    with pytest.raises(InvalidOptionError, match="repeats"):
        bench.bench(AIRME, repeats=0)
