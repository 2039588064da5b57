"""Copies of simulators and environments go on exactly as the original would; saved states can be returned to."""

from __future__ import annotations

import copy
import os
import pickle  # noqa: TID251 (what is tested is that users may)
import subprocess
import sys

import cloudpickle
import gymnasium
import numpy as np
import pytest
import torch

from marl_sched import airme_v0, murse_v0, ward_v0
from marl_sched.domain import get_domain
from marl_sched.errors import InvalidOptionError
from tests.envs.problems import HORIZON

STALE = {
    "airme": {"kind": "local", "reach": 2, "comm": 1, "staleness": 3},
    "murse": {"kind": "local"},
    "ward": {"kind": "local"},
}
IDS = {"airme": "marl_sched/AirME-v0", "murse": "marl_sched/MuRSE-v0", "ward": "marl_sched/Ward-v0"}
COPIES = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda thing: pickle.loads(pickle.dumps(thing)),  # noqa: S301 (written a line before)
    "cloudpickle": lambda thing: cloudpickle.loads(cloudpickle.dumps(thing)),
}
PAGES = {"airme": airme_v0, "murse": murse_v0, "ward": ward_v0}
APIS = ("aec", "parallel", "gymnasium", "torchrl")


@pytest.fixture(params=COPIES)
def duplicate(request):
    return COPIES[request.param]


@pytest.fixture(params=APIS)
def api(request):
    return request.param


@pytest.fixture
def simulator(domain):
    return domain.simulator(
        domain.instances("small", 3, seed=5), view=domain.make_view(STALE[domain.name]), horizon=HORIZON[domain.name]
    )


def make(domain, api):
    """A running environment, and the function that plays n steps of it and returns all that they gave."""
    if api == "torchrl":
        torch_env = pytest.importorskip("marl_sched.envs.api.torchrl_env")
        env = torch_env.SchedulingTorchRL(domain, batch_size=2, horizon=HORIZON[domain.name])
        env.reset()
        return env, play_torchrl
    options = {"horizon": HORIZON[domain.name]}
    if api == "gymnasium":
        env = gymnasium.make(IDS[domain.name], **options)
        env.reset(seed=1)
        return env, play_gymnasium
    options["view"] = STALE[domain.name]
    env = PAGES[domain.name].env(**options) if api == "aec" else PAGES[domain.name].parallel_env(**options)
    env.reset(seed=1)
    return env, play_aec if api == "aec" else play_parallel


def legal(mask, turn):
    choices = np.flatnonzero(mask)
    return int(choices[(7 * turn + 3) % len(choices)])


def frozen(value):
    """Anything that an environment returns, as something that can be compared."""
    if isinstance(value, dict):
        return {name: frozen(item) for name, item in value.items()}
    return value.tobytes() if isinstance(value, np.ndarray) else value


def play_aec(env, steps):
    out = []
    for turn in range(steps):
        if not env.agents:
            env.reset()
        observation, reward, terminated, truncated, info = env.last()
        out.append((env.agent_selection, frozen(observation), reward, terminated, truncated, frozen(info)))
        env.step(None if terminated or truncated else legal(observation["action_mask"], turn))
    return out


def play_parallel(env, steps):
    out, masks = [], {agent: env.observe(agent)["action_mask"] for agent in env.agents}
    for turn in range(steps):
        if not env.agents:
            observations, _ = env.reset()
            masks = {agent: seen["action_mask"] for agent, seen in observations.items()}
        observations, *rest = env.step({agent: legal(masks[agent], turn + i) for i, agent in enumerate(env.agents)})
        masks = {agent: seen["action_mask"] for agent, seen in observations.items()}
        out.append((frozen(observations), *map(frozen, rest)))
    return out


def play_gymnasium(env, steps):
    out, rng = [], np.random.default_rng(3)
    for _ in range(steps):
        observation, reward, terminated, truncated, info = env.step(rng.integers(0, env.action_space.nvec))
        out.append((frozen(observation), reward, terminated, truncated, info))
        if terminated or truncated:
            out.append(frozen(env.reset()[0]))
    return out


def play_torchrl(env, steps):
    out = []
    td = env.current()
    for turn in range(steps):
        actions = [legal(mask.numpy(), turn) for mask in td["action_mask"]]  # random ones follow torch's own generator
        data, td = env.step_and_maybe_reset(td.set("action", torch.tensor(actions)))
        out.append({name: value.numpy().tobytes() for name, value in data.flatten_keys(".").items()})
    return out


def play_simulator(simulator, steps):
    out = []
    for turn in range(steps):
        simulator.step(np.array([legal(mask, turn) for mask in simulator.legal()]))
        out.append((simulator.reward.tobytes(), simulator.acting.tobytes(), simulator.time.tobytes()))
        out.append(frozen(simulator.observe(simulator.acting)))
        if simulator.over.any():
            simulator.reset(simulator.over)
    return out


def test_a_copy_of_a_simulator_plays_on_as_the_original_would(simulator, duplicate):
    play_simulator(simulator, 9)
    twin = duplicate(simulator)
    assert play_simulator(twin, 150) == play_simulator(simulator, 150)


def test_a_copy_and_its_original_do_not_share_their_state(simulator, duplicate, bits):
    twin = duplicate(simulator)
    before = [bits(simulator.snapshot(b)) for b in range(3)]
    play_simulator(twin, 20)
    assert [bits(simulator.snapshot(b)) for b in range(3)] == before


def test_a_simulator_returns_to_a_saved_state_any_number_of_times(simulator):
    play_simulator(simulator, 9)
    saved = simulator.save_state()
    first = play_simulator(simulator, 150)  # across the ends of episodes
    for _ in range(2):
        simulator.load_state(saved)
        assert play_simulator(simulator, 150) == first


def test_another_simulator_takes_over_a_saved_state(domain, simulator):
    play_simulator(simulator, 9)
    other = domain.simulator(
        [domain.instances("small", 3, seed=5)[0]] * 3,
        view=simulator.view,
        horizon=HORIZON[domain.name],
        pad=None if simulator.max_agents == 0 else "small",
    )
    padded = domain.simulator(simulator.instances, view=simulator.view, horizon=HORIZON[domain.name], pad="small")
    play_simulator(padded, 9)
    other.load_state(pickle.loads(pickle.dumps(padded.save_state())))  # noqa: S301
    assert play_simulator(other, 80) == play_simulator(padded, 80)


def test_a_state_of_other_sizes_is_refused_and_changes_nothing(domain, simulator, bits):
    other = domain.simulator(simulator.instances[:2], view=simulator.view, horizon=HORIZON[domain.name])
    before = bits(simulator.snapshot(0))
    with pytest.raises(InvalidOptionError, match=r"load_state: expected a state of \w+ with the sizes .*\(2,"):
        simulator.load_state(other.save_state())
    assert bits(simulator.snapshot(0)) == before


def test_a_state_of_another_domain_is_refused():
    first, second = (get_domain(name) for name in ("airme", "murse"))
    saved = first.simulator(first.instances("small", 1, 0)).save_state()
    with pytest.raises(InvalidOptionError, match="got one of AirmeSimulator"):
        second.simulator(second.instances("small", 1, 0)).load_state(saved)


def test_a_domain_is_copied_as_itself(domain, duplicate):
    assert duplicate(domain) is domain


def test_a_copy_of_an_environment_plays_on_as_the_original_would(domain, api, duplicate):
    env, play = make(domain, api)
    play(env, 9)
    twin = duplicate(env)
    assert play(twin, 60) == play(env, 60)


def test_an_environment_returns_to_a_saved_state(domain, api):
    env, play = make(domain, api)
    play(env, 9)
    inner = env.unwrapped if api == "gymnasium" else env
    saved = inner.save_state()
    first = play(env, 60)
    inner.load_state(saved)
    assert play(env, 60) == first
    inner.load_state(pickle.loads(pickle.dumps(saved)))  # noqa: S301
    assert play(env, 60) == first


def test_a_state_of_another_api_is_refused(domain):
    aec, parallel = make(domain, "aec")[0].unwrapped, make(domain, "parallel")[0]
    with pytest.raises(InvalidOptionError, match="load_state: expected a state of SchedulingParallel"):
        parallel.load_state(aec.save_state())


def test_observations_in_arrays_of_other_shapes_are_refused(simulator):
    out = simulator.new_observation()
    name = next(iter(out))
    for wrong in (out[name][:2], out[name][:, :1].copy()):  # contiguous, as another layout is compiled first
        with pytest.raises(InvalidOptionError, match="expected arrays of the shapes that new_observation"):
            simulator.observe(simulator.acting, {**out, name: wrong})
    with pytest.raises(InvalidOptionError, match="below max_agents"):
        simulator.observe(np.full(3, simulator.max_agents))


def test_kernels_refuse_arrays_that_do_not_belong_together(domain, simulator):
    from marl_sched.envs.airme import dynamics as airme
    from marl_sched.envs.murse import dynamics as murse
    from marl_sched.envs.ward import dynamics as ward

    kernels = {"airme": airme, "murse": murse, "ward": ward}[domain.name]
    targets = np.zeros(3, np.int64)
    with pytest.raises(ValueError, match="do not belong together"):
        kernels.step(simulator.state._replace(rows=simulator.state.rows[:2]), simulator.rules, targets)
    with pytest.raises(ValueError, match="do not belong together"):
        kernels.step(simulator.state, simulator.rules, targets[:2])
    simulator.state.rows[{"airme": "n_crews", "murse": "n_agents", "ward": "n_nurses"}[domain.name]][1] = 99
    with pytest.raises(ValueError, match="does not fit into its arrays"):
        kernels.step(simulator.state, simulator.rules, targets)


def test_a_round_of_an_episode_that_is_over_is_refused():
    """The kernel itself refuses, whoever calls it: it would write a round behind the last."""
    from marl_sched.envs.murse import dynamics

    domain = get_domain("murse")
    simulator = domain.simulator(domain.instances("small", 1, seed=0), horizon=1)
    nothing = np.empty(0, np.int64)
    dynamics.play_round(simulator.state, simulator.rules, 0, nothing, nothing)
    assert simulator.over[0]
    with pytest.raises(ValueError, match="no round of this row can take this plan"):
        dynamics.play_round(simulator.state, simulator.rules, 0, nothing, nothing)


CHECKED = """
import copy, sys, numpy as np
from marl_sched.domain import get_domain
name, horizon, *views = sys.argv[1:]
domain = get_domain(name)
for view in views:
    for pad in (None, "small"):
        options = {"view": domain.make_view(view), "horizon": int(horizon), "pad": pad}
        simulator = domain.simulator(domain.instances("small", 2, 3), **options)
        for turn in range(120):
            simulator = copy.deepcopy(simulator) if turn % 25 == 7 else simulator
            masks = simulator.legal()
            picks = [np.flatnonzero(mask)[(7 * turn + 3) % mask.sum()] for mask in masks]
            picks[0] = picks[0] if turn % 11 else simulator.max_actions - 1
            simulator.step(np.array(picks))
            simulator.observe_all()
            if simulator.over.any():
                simulator.reset(simulator.over)
        simulator.objectives()
        central = domain.central
        single = domain.simulator(domain.instances("small", 1, 4), horizon=2, pad="small")
        rng = np.random.default_rng(0)
        while not single.over[0]:
            central.play(single, rng.integers(0, central.action_space(single).nvec))
print("no index went astray")
"""


@pytest.mark.slow
@pytest.mark.timeout(600)  # nearly a minute on an idle core: the domain's kernels are compiled once more
@pytest.mark.parametrize(
    "play",
    [("airme", "30", "full", "local", "random"), ("murse", "2", "full", "local"), ("ward", "4", "full", "local")],
    ids=lambda play: play[0],
)
def test_no_kernel_reaches_outside_its_arrays(play):
    """All kernels compiled with checks of every index, on copies and padded rows too."""
    environment = {**os.environ, "NUMBA_BOUNDSCHECK": "1", "NUMBA_OPT": "0"}
    done = subprocess.run(
        [sys.executable, "-c", CHECKED, *play],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=580,
    )
    assert done.stdout == "no index went astray\n", done.stderr
