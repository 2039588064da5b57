"""What a crew sees: its neighbourhood, pictures that are hours old, what it was told, and nothing else."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from marl_sched.envs.airme.features import graph_spec
from marl_sched.envs.airme.instance import AirmeInstance, generate
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.envs.airme.state import UNDECIDED
from marl_sched.envs.airme.views import FullView, LocalView
from marl_sched.errors import InvalidOptionError
from tests.airme.fleets import RESERVE, fleet, play

FEATURE = {name: k for k, name in enumerate(graph_spec(0).node("plane").features)}


def ring(a: int, b: int, n: int) -> int:
    return min((a - b) % n, (b - a) % n)


def played(instance: AirmeInstance, view: LocalView, turns: int, seed: int) -> AirmeSimulator:
    """A simulator after some turns, each a random choice that is legal in the acting crew's view."""
    simulator = AirmeSimulator([instance], view=view, horizon=200, seed=seed)
    rng = np.random.default_rng(seed)
    for _ in range(turns):
        legal = np.flatnonzero(simulator.legal()[0])
        simulator.step(np.array([rng.choice(legal) if rng.random() < 0.6 else 0]))
    return simulator


class Hidden:
    """Which parts of a simulator's state the acting crew of row 0 must not be able to tell."""

    def __init__(self, simulator: AirmeSimulator, view: LocalView) -> None:
        self.state, self.agent, self.now = simulator.state, int(simulator.acting[0]), int(simulator.time[0])
        n = int(simulator.n_agents[0])
        slots = np.arange(1, int(simulator.state.rows["n_planes"][0]) + 1)
        apart = np.array([ring(self.agent, (slot - 1) % n, n) for slot in slots])
        stale = (apart > 0) & (apart <= view.reach) & (view.staleness > 0)
        self.snapshot_hour = max(0, self.now - view.staleness)
        self.out_of_reach, self.stale = slots[apart > view.reach], slots[stale]
        self.fresh = slots[(apart <= view.reach) & ~stale]
        self.silent_crews = np.array([c for c in range(n) if ring(self.agent, c, n) > view.comm], int)
        self.other_crews = np.array([c for c in range(n) if c != self.agent], int)
        self.n_planes = len(slots)

    def told(self) -> np.ndarray:
        """Stale slots of which the crew has a status that is not older than the picture."""
        if not len(self.state.private_memory_at):
            return self.stale[:0]
        return self.stale[self.state.private_memory_at[0, self.agent, self.stale] >= self.snapshot_hour]

    def scramble(self, rng: np.random.Generator) -> int:
        """Change everything that is hidden; how many records were changed."""
        changed = self._scramble_planes(self.state.planes[0], np.concatenate([self.out_of_reach, self.stale]), rng)
        for crew in self.silent_crews:
            record = self.state.crews[0, crew]
            record["plane"] = rng.integers(0, self.n_planes + 1)
            record["job_hours"], record["job_done"] = rng.integers(0, 40, 2)
            record["choice"] = rng.integers(UNDECIDED, self.n_planes + 1)
            changed += 1
        if len(self.silent_crews):  # who, of those it cannot hear, has chosen or repairs a plane it sees
            seen = self.state.planes[0][self.fresh]
            free = ~np.isin(seen["chosen"], np.setdiff1d(np.arange(-1, 99), [-1, *self.silent_crews]))
            self.state.planes["chosen"][0, self.fresh[free]] = rng.choice([-1, *self.silent_crews], free.sum())
            theirs = np.isin(seen["crew"], self.silent_crews)
            self.state.planes["crew"][0, self.fresh[theirs]] = rng.choice(self.silent_crews, theirs.sum())
        for hour in range(self.state.past.shape[1]):
            snapshot = hour == self.snapshot_hour % self.state.past.shape[1]
            unseen = np.setdiff1d(np.arange(1, self.n_planes + 1), self.stale if snapshot else [])
            hidden = np.union1d(unseen, self.told())
            changed += self._scramble_planes(self.state.past[0, hour], hidden, rng)
        if len(self.state.private_memory_at):
            for crew in self.other_crews:
                changed += self._scramble_planes(
                    self.state.private_memory[0, crew], np.arange(1, self.n_planes + 1), rng
                )
                self.state.private_memory_at[0, crew] = rng.integers(
                    -1, self.now + 1, self.state.private_memory_at.shape[2]
                )
            unused = np.setdiff1d(np.arange(1, self.n_planes + 1), self.told())
            self._scramble_planes(self.state.private_memory[0, self.agent], unused, rng)
            self.state.private_memory_at[0, self.agent, self.out_of_reach] = rng.integers(-1, self.now + 1)
        self.state.rows["sums"][0] = rng.random(3)
        self.state.rows["total_income"][0] = rng.random()
        self.state.series[0] = rng.random(self.state.series[0].shape)
        return changed

    @staticmethod
    def _scramble_planes(planes: np.ndarray, slots: np.ndarray, rng: np.random.Generator) -> int:
        for slot in slots:
            record = planes[slot]
            record["income"], record["job_cost"] = rng.uniform(1, 20, 2)
            for name in ("hours", "landings", "job_hours", "job_done", "mission_hours", "mission_done"):
                record[name] = rng.integers(0, 60)
            record["kind"], record["broken"] = rng.integers(0, 2, 2)
            record["crew"], record["chosen"] = rng.integers(-1, 3, 2)
        return len(slots)


def observed(simulator: AirmeSimulator) -> dict[str, np.ndarray]:
    return simulator.observe(simulator.acting)


views = st.builds(LocalView, reach=st.integers(0, 2), comm=st.integers(0, 2), staleness=st.sampled_from([0, 1, 3, 12]))


@settings(deadline=None, max_examples=80)
@given(view=views, turns=st.integers(0, 150), seed=st.integers(0, 10_000))
def test_nothing_hidden_reaches_the_observation(view: LocalView, turns: int, seed: int) -> None:
    instance = generate("small", np.random.default_rng(seed % 7))
    simulator = played(instance, view, turns, seed)
    before = observed(simulator)
    changed = Hidden(simulator, view).scramble(np.random.default_rng(seed))
    after = observed(simulator)
    assert changed > 0
    assert before.keys() == after.keys()
    for name in before:
        np.testing.assert_array_equal(before[name], after[name], err_msg=name)


@pytest.mark.parametrize("too_much", [{"reach": 2}, {"comm": 2}, {"staleness": 2}])
def test_the_property_above_notices_a_view_that_shows_too_much(too_much: dict[str, int]) -> None:
    allowed = {"reach": 1, "comm": 1, "staleness": 3}
    noticed = 0
    for seed in range(20):
        view = LocalView(**{**allowed, **too_much})
        simulator = played(generate("small", np.random.default_rng(seed)), view, 99, seed)
        before = observed(simulator)
        hidden = Hidden(simulator, LocalView(**allowed))
        hidden.scramble(np.random.default_rng(seed))
        noticed += any((before[name] != value).any() for name, value in observed(simulator).items())
    assert noticed >= 15


@settings(deadline=None, max_examples=40)
@given(view=views, turns=st.integers(0, 150), seed=st.integers(0, 10_000), data=st.data())
def test_what_is_in_view_reaches_the_observation(view: LocalView, turns: int, seed: int, data: st.DataObject) -> None:
    simulator = played(generate("small", np.random.default_rng(seed % 7)), view, turns, seed)
    hidden, before = Hidden(simulator, view), observed(simulator)
    told = hidden.told()
    snapshot_hour = np.setdiff1d(hidden.stale, told)
    state, agent = simulator.state, hidden.agent
    own = data.draw(st.sampled_from(hidden.fresh.tolist()))
    controls: dict[str, Callable[[], object]] = {
        "a plane that it sees as it is": lambda: state.planes["hours"][0].__setitem__(own, 777),
        "the own crew": lambda: state.crews["job_done"][0].__setitem__(agent, 5),
    }
    if len(snapshot_hour):
        hour = hidden.snapshot_hour % state.past.shape[1]
        slot = data.draw(st.sampled_from(snapshot_hour.tolist()))
        controls["the delayed snapshot of a stale sector"] = lambda: state.past["hours"][0, hour].__setitem__(slot, 777)
    if len(told):
        known = data.draw(st.sampled_from(told.tolist()))
        controls["what the crew was told"] = lambda: state.private_memory["hours"][0, agent].__setitem__(known, 777)
    heard = np.setdiff1d(hidden.other_crews, hidden.silent_crews)
    if len(heard):
        other = data.draw(st.sampled_from(heard.tolist()))
        controls["a crew that it hears"] = lambda: state.crews["job_done"][0].__setitem__(other, 777)
    data.draw(st.sampled_from(sorted(controls)).map(controls.__getitem__))()
    after = observed(simulator)
    assert any((before[name] != after[name]).any() for name in before)


@settings(deadline=None, max_examples=30)
@given(reach=st.integers(0, 2), comm=st.integers(0, 2), turns=st.integers(0, 100), seed=st.integers(0, 10_000))
def test_mask_and_share_follow_from_what_is_visible(reach: int, comm: int, turns: int, seed: int) -> None:
    instance = generate("small", np.random.default_rng(seed % 7))
    simulator = played(instance, LocalView(reach=reach, comm=comm), turns, seed)
    assume(not simulator.over[0])
    agent, n = int(simulator.acting[0]), instance.n_crews
    near = np.array([ring(agent, p % n, n) <= reach for p in range(instance.n_planes)])
    seen = observed(simulator)
    padded = np.zeros(simulator.max_actions - 1, bool)
    padded[: len(near)] = near
    np.testing.assert_array_equal(seen["plane_mask"][0, 1:], padded)
    assert seen["visible_share"][0] == np.float32(near.mean())
    assert not seen["plane"][0, 1:][~padded].any()
    np.testing.assert_array_equal(seen["crew_mask"][0, :n], [ring(agent, c, n) <= comm for c in range(n)])
    assert not seen["action_mask"][0, 1:][~padded].any()
    assert seen["action_mask"][0, 0] == 1


def test_full_view_sees_all_and_masks_exactly_what_is_impossible() -> None:
    instance = generate("small", np.random.default_rng(3))
    simulator = AirmeSimulator([instance], horizon=50)
    rng = np.random.default_rng(0)
    while not simulator.over[0]:
        seen = observed(simulator)
        planes = simulator.state.planes[0]
        possible = (planes["crew"] < 0) & (planes["chosen"] < 0)
        possible[0] = True
        np.testing.assert_array_equal(seen["action_mask"][0], possible)
        assert seen["visible_share"][0] == 1.0
        simulator.step(np.array([rng.choice(np.flatnonzero(possible))]))
        assert not simulator.conflict[0]


# Three crews, one plane in each sector; nothing flies, nothing fails. Crew 1 cannot hear crew 0.
THREE = fleet(*[(RESERVE, 10.0, 24 * 9, 0, True)] * 3, n_crews=3)
FAR_SIGHTED = {"reach": 1, "comm": 0}


def features(simulator: AirmeSimulator, agent: int, slot: int) -> dict[str, float]:
    seen = simulator.observe(np.array([agent]))["plane"][0, slot]
    return {name: float(seen[k]) for name, k in FEATURE.items()}


def test_sector_of_another_crew_is_seen_as_it_was() -> None:
    simulator = AirmeSimulator([THREE], view=LocalView(**FAR_SIGHTED, staleness=3))
    play(simulator, [1, 0, 0])
    for now in range(1, 10):
        seen, own = features(simulator, 1, 1), features(simulator, 0, 1)
        assert own["job_done/10"] == pytest.approx(now / 10)
        assert own["age_hours/10"] == 0.0
        assert seen["age_hours/10"] == pytest.approx(min(now, 3) / 10)
        assert seen["job_done/10"] == pytest.approx(max(now - 3, 0) / 10)
        assert seen["free"] == (now <= 3)
        play(simulator, [0, 0, 0])


def test_without_staleness_another_sector_is_seen_as_it_is() -> None:
    simulator = AirmeSimulator([THREE], view=LocalView(**FAR_SIGHTED))
    play(simulator, [1, 0, 0])
    assert features(simulator, 1, 1)["in_repair"] == 1.0
    assert features(simulator, 1, 1)["age_hours/10"] == 0.0


def test_picture_is_of_hour_zero_until_it_is_staleness_hours_old() -> None:
    simulator = AirmeSimulator([THREE], view=LocalView(**FAR_SIGHTED, staleness=12))
    play(simulator, [1, 0, 0])
    for now in range(1, 15):
        assert features(simulator, 1, 1)["free"] == (now <= 12)
        play(simulator, [0, 0, 0])


def test_choice_is_known_to_those_who_hear_it_alone() -> None:
    for comm, free in ((0, 1), (1, 0)):
        simulator = AirmeSimulator([THREE], view=LocalView(reach=1, comm=comm))
        simulator.step(np.array([3]))
        seen = observed(simulator)
        assert simulator.acting[0] == 1
        assert seen["action_mask"][0, 3] == free
        assert seen["plane"][0, 3, FEATURE["chosen_this_hour"]] == 1 - free
        assert seen["repairing"][0, 0] == (3 if comm else -1)


@pytest.mark.parametrize("staleness", [0, 3])
def test_choice_that_is_legal_in_the_view_and_impossible_in_truth_idles_the_crew(staleness: int) -> None:
    simulator = AirmeSimulator([THREE], view=LocalView(**FAR_SIGHTED, staleness=staleness))
    simulator.step(np.array([3]))
    assert simulator.legal()[0, 3] == 1  # the mask comes from the view alone
    simulator.step(np.array([3]))
    assert simulator.conflict[0]
    simulator.step(np.array([0]))
    assert not simulator.conflict[0]
    assert simulator.snapshot(0)["crews"]["plane"].tolist() == [3, 0, 0]
    assert simulator.time[0] == 1


def test_outcome_of_a_conflict_is_told_and_kept_until_the_picture_is_newer() -> None:
    simulator = AirmeSimulator([THREE], view=LocalView(**FAR_SIGHTED, staleness=3))
    play(simulator, [0, 0, 0], [3, 3, 0])  # in hour 1 crew 0 takes plane 3 and crew 1 runs into it
    for now in (2, 3, 4):  # pictures of hours 0, 0, 1 still show the plane free; crew 1 knows better
        seen = features(simulator, 1, 3)
        assert (seen["in_repair"], seen["free"]) == (1.0, 0.0)
        assert seen["age_hours/10"] == pytest.approx((now - 1) / 10)
        assert simulator.observe(np.array([1]))["action_mask"][0, 3] == 0
        play(simulator, [0, 0, 0])
    newer = features(simulator, 1, 3)  # hour 5 shows hour 2: the repair's first hour is done
    assert newer["age_hours/10"] == pytest.approx(0.3)
    assert newer["job_done/10"] == pytest.approx(0.1)


def test_crew_remembers_how_it_left_a_plane_it_repaired() -> None:
    view = LocalView(reach=1, comm=0, staleness=12)
    simulator = AirmeSimulator([fleet(*[(RESERVE, 10.0, 50, 0, False)] * 3, n_crews=3)], view=view)
    play(simulator, [0, 1, 0])
    while simulator.state.crews["plane"][0, 1]:
        play(simulator, [0, 0, 0])
    now = int(simulator.time[0])
    assert now <= 10  # 2 to 8 hours + floor(50/24): the picture is still of hour 0
    mine, anothers = features(simulator, 1, 1), features(simulator, 2, 1)
    assert (mine["hours/10"], mine["age_hours/10"], mine["free"]) == (0.0, 0.0, 1.0)
    assert anothers["hours/10"] == 5.0
    assert anothers["age_hours/10"] == pytest.approx(now / 10)
    play(simulator, [0, 0, 0])
    assert features(simulator, 1, 1)["age_hours/10"] == pytest.approx(0.1)


def test_crew_that_is_busy_or_has_acted_may_do_nothing_else() -> None:
    simulator = AirmeSimulator([THREE])
    simulator.step(np.array([1]))
    assert simulator.observe(np.array([0]))["action_mask"][0].tolist() == [1, 0, 0, 0]
    simulator.step(np.array([0]))
    simulator.step(np.array([0]))
    assert simulator.time[0] == 1
    assert simulator.observe(np.array([0]))["action_mask"][0].tolist() == [1, 0, 0, 0]
    assert simulator.observe(np.array([1]))["action_mask"][0].tolist() == [1, 0, 1, 1]


def test_nobody_sees_an_empty_graph_and_may_do_nothing() -> None:
    simulator = AirmeSimulator([THREE])
    seen = simulator.observe(np.array([-1]))
    assert seen["action_mask"][0].tolist() == [1, 0, 0, 0]
    for name in ("plane", "plane_mask", "crew", "crew_mask", "state", "visible_share"):
        assert not seen[name].any(), name


def test_reused_arrays_hold_nothing_of_the_last_observation() -> None:
    instances = [generate("small", np.random.default_rng(k)) for k in range(2)]
    simulator = AirmeSimulator(instances, view=LocalView(reach=1, comm=1, staleness=3), horizon=40)
    rng = np.random.default_rng(0)
    out = simulator.new_observation()
    for _ in range(100):
        simulator.observe(rng.integers(-1, 6, 2), out)
        simulator.observe(simulator.acting, out)
        fresh = simulator.observe(simulator.acting)
        for name in fresh:
            np.testing.assert_array_equal(fresh[name], out[name], err_msg=name)
        simulator.step(np.array([rng.choice(np.flatnonzero(mask)) for mask in fresh["action_mask"]]))


def test_observation_is_finite_and_within_the_declared_bounds() -> None:
    simulator = played(generate("small", np.random.default_rng(1)), LocalView(reach=2, comm=1, staleness=3), 200, 1)
    seen = observed(simulator)
    for name, spec in simulator.arrays.items():
        assert seen[name].shape == (1, *spec.shape)
        assert seen[name].dtype == spec.dtype
        assert np.isfinite(seen[name]).all()
        assert (seen[name] >= spec.low).all(), name
        assert (seen[name] <= spec.high).all(), name


@pytest.mark.parametrize("option", ["reach", "comm", "staleness"])
@pytest.mark.parametrize("value", [-1, 1.5, "x", True, None, 10**30, pytest.param(10**5000, id="huge")])
def test_view_option_that_is_no_integer_of_its_range_raises(option: str, value: object) -> None:
    with pytest.raises(InvalidOptionError, match=rf"view local: {option}: expected an integer in \[0, \d+\], got "):
        LocalView(**{option: value})  # type: ignore[arg-type]


def test_staleness_of_more_than_a_year_raises() -> None:
    with pytest.raises(InvalidOptionError, match=r"staleness: expected an integer in \[0, 8760\], got 1000000000"):
        LocalView(staleness=10**9)


def test_view_options_of_numpy_become_plain_integers() -> None:
    assert [type(value) for value in LocalView(reach=np.int64(2), comm=np.uint8(1)).limits] == [int, int, int]  # type: ignore[arg-type]


def test_full_view_has_no_options() -> None:
    with pytest.raises(TypeError):
        FullView(reach=1)  # type: ignore[call-arg]
