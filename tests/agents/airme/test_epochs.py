"""Decision epochs played in one compiled call, held bit by bit against turns with observations."""

from __future__ import annotations

import numpy as np
import pytest

from marl_sched.agents.airme.schedulers import RULES
from marl_sched.envs.airme.instance import AirmeInstance, generate
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.envs.airme.views import FullView, LocalView, RandomView, View

COMPILED = [name for name in RULES if name != "random"]
VIEWS = [FullView(), LocalView(), LocalView(reach=0, comm=2), LocalView(reach=2, comm=1, staleness=7), RandomView()]


def instances() -> list[AirmeInstance]:
    """Three fleets of two scales."""
    return [generate(scale, np.random.default_rng(s)) for s, scale in enumerate(("small", "medium", "small"))]


def simulator(fleets: list[AirmeInstance], view: View, scheme: str = "full") -> AirmeSimulator:
    """Sixty hours of the fleets, or fewer where half of the planes are broken before."""
    return AirmeSimulator(fleets, view=view, scheme=scheme, horizon=60, seed=3, stop_share=0.5)


def play_both(name: str, view: View, scheme: str = "full", count: int = 3) -> float:
    """Play a rule both ways on one row, comparing its whole state whenever both stand at one hour; the share seen."""
    fleet = instances()[:1]
    by_turns, by_epochs = simulator(fleet, view, scheme), simulator(fleet, view, scheme)
    rule = RULES[name]()
    rule.start(by_turns, np.ones(1, bool))
    player = rule.epoch_player(by_epochs)
    assert player is not None
    shares, turns, taken = 0.0, 0, 0
    while by_epochs.acting[0] >= 0:
        share, decisions = player(count)
        shares, turns = shares + share, turns + decisions
        while by_turns.acting[0] >= 0 and by_turns.time[0] < by_epochs.time[0]:
            by_turns.step(rule.decide(by_turns))
            taken += 1
        assert taken == turns
        for part in by_epochs.state._fields:
            np.testing.assert_array_equal(getattr(by_epochs.state, part), getattr(by_turns.state, part))
    assert by_turns.over.all()
    return shares / turns


@pytest.mark.parametrize("view", VIEWS, ids=str)
@pytest.mark.parametrize("name", [name for name in COMPILED if not name.startswith("index")])
def test_epochs_of_a_rule_are_its_turns_under_every_view(name: str, view: View) -> None:
    share = play_both(name, view)
    assert 0 < share <= 1
    assert share == 1 or view != FullView()


@pytest.mark.parametrize("view", VIEWS[:2], ids=str)
@pytest.mark.parametrize("scheme", ["skip", "single"])
def test_epochs_end_where_a_scheme_ends_the_decisions_of_an_hour(scheme: str, view: View) -> None:
    play_both("condition", view, scheme, count=1)


@pytest.mark.slow
@pytest.mark.parametrize("view", VIEWS, ids=str)
@pytest.mark.parametrize("name", ["index", "index-without-clock"])
def test_epochs_of_the_index_are_its_turns_under_every_view(name: str, view: View) -> None:
    play_both(name, view)


@pytest.mark.parametrize("view", [FullView(), LocalView(staleness=4)], ids=str)
def test_a_row_plays_in_a_batch_as_it_does_alone(view: View) -> None:
    batch = simulator(instances(), view)
    player = RULES["condition"]().epoch_player(batch)
    assert player is not None
    while (batch.acting >= 0).any():
        player(2)
    for row, fleet in enumerate(instances()):
        alone = simulator([fleet], view)
        player = RULES["condition"]().epoch_player(alone)
        assert player is not None
        player(10_000)
        assert alone.over.all()
        np.testing.assert_array_equal(alone.state.series[0], batch.state.series[row])
