"""Checks that a domain, its views and its schedulers hold to the contract; for the tests of whoever writes one.

    from marl_sched.testing import check_domain, check_scheduler, check_view

    def test_the_domain_holds_to_the_contract():
        check_domain("couriers", scale="town", horizon=8)

Each raises ConformanceError, which is an AssertionError, and says what was not as promised. A check plays a few short
episodes; its choices depend on the action mask and the number of the turn alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from marl_sched.domain import Domain, get_domain
from marl_sched.graph import ACTION_MASK, AVAILABLE
from marl_sched.problem import Problem
from marl_sched.simulation import Observation, TurnSimulator

if TYPE_CHECKING:
    from marl_sched.agents.base import Scheduler

BATCH, PLACE = 4, 2  # envs of the batched episode, and which of them plays the instance


class ConformanceError(AssertionError):
    """Something that the contract promises and that was not so."""


Trace = list[dict[str, Any]]
"""One dict per turn: agent, time, seen (bytes by array), action, reward, elapsed, after (bytes by field)."""


def check_domain(
    domain: Domain | str, *, scale: str | None = None, horizon: int | None = None, instances: int = 2, seed: int = 11
) -> None:
    """Hold a domain to its contract, under each of its views with their default options.

    Instances come back from their files; the simulator keeps its promises at every turn (`check_turns`); the same
    choices give the same trace in a batch, in PettingZoo's AEC and, where torch is installed, in TorchRL, to the last
    bit; with telemetry every agent's local state shows what the simulator shows it, and a turn in which no time passes
    changes no channel but those that `turn_channels` names.
    """
    domain = domain if isinstance(domain, Domain) else get_domain(domain)
    for kind in domain.views:
        problem = Problem(domain, scale=scale, count=instances, horizon=horizon, view=kind, seed=seed)
        for instance in problem.instances:
            _check_files(domain, instance)
            one = problem.but(instances=[instance], pad=problem.pad)
            trace = check_turns(one.simulator())
            _same(f"{kind}: played again", trace, check_turns(one.simulator()))
            _check_batch(one, trace)
            _check_aec(one, trace)
            if find_spec("torchrl") is not None:
                _check_torchrl(one, trace)
            if domain.telemetry is not None:
                _check_telemetry(one)


def check_turns(simulator: TurnSimulator) -> Trace:
    """Play env 0 of a simulator at the start of its episodes to the end, checking every turn; the trace."""
    trace: Trace = []
    time, progress = int(simulator.time[0]), int(simulator.progress[0])
    _require(time == 0 and progress == 0, "an episode begins at time 0 and progress 0")
    while simulator.acting[0] >= 0:
        observation = simulator.observe(simulator.acting)
        _check_observation(simulator, observation)
        action = _choice(observation[ACTION_MASK][0], len(trace))
        turn: dict[str, Any] = {"agent": int(simulator.acting[0]), "time": int(simulator.time[0]), "action": action}
        turn["seen"] = {name: array[0].tobytes() for name, array in observation.items()}
        actions = np.where(simulator.acting >= 0, [_choice(mask, len(trace)) for mask in observation[ACTION_MASK]], 0)
        simulator.step(actions)
        turn |= {"reward": float(simulator.reward[0]), "elapsed": int(simulator.elapsed[0])}
        turn["after"] = dict(_bits(simulator.snapshot(0)))
        trace.append(turn)
        _require(simulator.time[0] == time + simulator.elapsed[0], "time grows by what elapsed")
        _require(progress <= simulator.progress[0] <= simulator.length[0], "progress never falls nor passes the length")
        time, progress = int(simulator.time[0]), int(simulator.progress[0])
        _require(len(trace) < 100_000, "an episode of a check ends within 100000 turns")
    _require(bool(simulator.over[0]), "nobody is to act only where the episode is over")
    _require(simulator.progress_share[0] == 1.0, "an episode that is over has progressed to its end")
    return trace


def _check_observation(simulator: TurnSimulator, observation: Observation) -> None:
    """Arrays as announced, the mask, and presence and availability of nodes."""
    graph = simulator.graph
    _require(set(observation) == set(simulator.arrays), "an observation has the arrays that `arrays` announces")
    for name, spec in simulator.arrays.items():
        array = observation[name]
        _require(
            array.shape == (simulator.batch, *spec.shape) and array.dtype == spec.dtype, f"{name}: shape and dtype"
        )
        _require(bool(((array >= spec.low) & (array <= spec.high)).all()), f"{name}: within its bounds, no NaN")
    mask = observation[ACTION_MASK][0] > 0
    _require(bool(mask[0]), "action 0 is always legal")
    agent, agents = int(simulator.acting[0]), simulator.free_agents(0)
    _require(agent in agents, "the acting agent is one of the free agents")
    for node, present in simulator.presence.items():
        visible = observation[f"{node}_mask"][0] > 0
        _require(not (visible & ~present[0]).any(), f"{node}: a node that is not there is not visible")
        if not getattr(simulator.view, "hides", True):
            _require(bool((visible == present[0]).all()), f"{node}: a view that hides nothing shows all that is there")
        if node == graph.decision_of:
            _require(not (mask & ~present[0])[1:].any(), "what is not there cannot be chosen")
    for node, available in simulator.availability.items():
        visible = observation[f"{node}_mask"][0] > 0
        column = graph.node(node).features.index(AVAILABLE)
        shown = observation[node][0, :, column] > 0
        _require(bool((shown == available[0])[visible].all()), f"{node}: the feature {AVAILABLE!r} tells availability")
        if node == graph.decision_of:
            _require(not (mask & ~available[0])[1:].any(), "what is not available cannot be chosen")
    for node, there in (*simulator.presence.items(), *simulator.availability.items()):
        if there.shape[1] == simulator.max_agents and node != graph.decision_of:
            _require(bool(there[0, agents].all()), f"{node}: an agent that is away has no turn")


def check_scheduler(
    domain: Domain | str, create: Callable[[], Scheduler], *, scale: str | None = None, horizon: int | None = None
) -> None:
    """Hold a scheduler to its contract on a domain: `create` makes a fresh one.

    Its actions are int64 (B,) and legal; it decides the same when it plays again, and for an env of a batch the same
    as alone; one that needs an observation alone, or a memory too, decides the same as agents by themselves.
    """
    from marl_sched.agents.base import ObservationScheduler
    from marl_sched.agents.recurrent import RecurrentScheduler

    problem = Problem(domain, scale=scale, count=BATCH, horizon=horizon, seed=5)
    together = _decisions(create(), problem.simulator())
    _require(together == _decisions(create(), problem.simulator()), "a scheduler decides the same when it plays again")
    alone = _decisions(create(), problem.but(instances=[problem.instances[PLACE]], pad=problem.pad).simulator())
    _require(together[PLACE] == alone[0], "a scheduler decides for an env of a batch as it does for it alone")
    scheduler = create()
    if isinstance(scheduler, ObservationScheduler):
        simulator = problem.simulator([PLACE])
        scheduler.start(simulator, np.ones(1, np.bool_))
        seen, noise = simulator.observe(simulator.acting), simulator.policy_noise(simulator.acting)
        single = {name: array[0] for name, array in seen.items()}
        chosen = scheduler.act(single, float(noise[0]))
        _require(chosen == alone[0][0], "act() on one observation chooses what decide() chooses")
    if isinstance(scheduler, RecurrentScheduler):
        by_themselves = _decisions_of_agents(create, problem.simulator([PLACE]))
        _require(by_themselves == alone[0], "agents with memories of their own choose what decide() chooses")


def _decisions_of_agents(create: Callable[[], Scheduler], simulator: TurnSimulator) -> list[int]:
    """What agents choose in env 0, each by a scheduler and with a memory of its own."""
    from marl_sched.agents.recurrent import LocalAgent

    agents, made = [LocalAgent(create()) for _ in range(simulator.max_agents)], []  # type: ignore[arg-type]
    while simulator.acting[0] >= 0:
        seen, noise = simulator.observe(simulator.acting), simulator.policy_noise(simulator.acting)
        made.append(agents[simulator.acting[0]].choose(seen, float(noise[0])))
        simulator.step(np.array(made[-1:]))
    return made


def _decisions(scheduler: Scheduler, simulator: TurnSimulator) -> list[list[int]]:
    """What a scheduler chose in each env, checked to be legal."""
    scheduler.start(simulator, np.ones(simulator.batch, np.bool_))
    made: list[list[int]] = [[] for _ in range(simulator.batch)]
    while (simulator.acting >= 0).any():
        legal = simulator.legal()
        actions = scheduler.decide(simulator)
        right = isinstance(actions, np.ndarray) and actions.shape == (simulator.batch,) and actions.dtype == np.int64
        _require(right, f"decide() gives int64 ({simulator.batch},), got {actions!r}")
        for b in np.flatnonzero(simulator.acting >= 0):
            _require(legal[b, actions[b]] > 0, f"env {b}: action {actions[b]} is legal for its agent")
            made[b].append(int(actions[b]))
        simulator.step(actions)
    return made


def check_view(
    problem: Problem,
    scramble_hidden: Callable[[TurnSimulator, int, np.random.Generator], None],
    scramble_seen: Callable[[TurnSimulator, int, np.random.Generator], None],
    *,
    seeds: int = 10,
) -> None:
    """Hold a view to hiding what it hides: `problem` is played under it for a while, then its state is disturbed.

    `scramble_hidden` changes, in env 0 of the simulator, everything that the agent must not see: the observation has
    to stay the same. `scramble_seen` changes something that it sees: the observation has to change, in at least half
    of the cases, which shows that the first comparison can fail. Both get a generator to draw new values from.
    """
    noticed = 0
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        simulator = problem.simulator([seed % problem.count], seed=seed)
        for number in range(int(rng.integers(30))):
            ahead = simulator.legal()
            if simulator.acting[0] < 0 or simulator.progress[0] + 1 >= simulator.length[0]:
                break
            simulator.step(np.array([_choice(ahead[0], number)]))
        if simulator.acting[0] < 0:
            continue
        agent = int(simulator.acting[0])
        before = _copy(simulator.observe(simulator.acting))
        scramble_hidden(simulator, agent, rng)
        after = _copy(simulator.observe(np.array([agent])))
        for name, array in before.items():
            _require(array.tobytes() == after[name].tobytes(), f"seed {seed}: {name} shows what the view hides")
        scramble_seen(simulator, agent, rng)
        changed = simulator.observe(np.array([agent]))
        noticed += any(array.tobytes() != changed[name].tobytes() for name, array in after.items())
    _require(
        2 * noticed >= seeds, f"a change of what is seen is noticed in at least half of {seeds} cases, not {noticed}"
    )


def _check_files(domain: Domain, instance: Any) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "instance.json"
        instance.save(path)
        _require(domain.load(path).identity == instance.identity, "an instance comes back from its file")
    again = domain.decode(instance.as_json(), "check")
    _require(again.identity == instance.identity, "an instance comes back from its JSON")


def _check_batch(problem: Problem, trace: Trace) -> None:
    """Among others of its scale an instance has the same trace, whatever the others do."""
    others = problem.domain.instances(str(problem.pad), BATCH, problem.seed + 1)
    others[PLACE] = problem.instances[0]
    simulator = problem.but(instances=others).simulator()
    for number, turn in enumerate(trace):
        seen = simulator.observe(simulator.acting)
        _require(simulator.acting[PLACE] == turn["agent"], f"turn {number}: the same agent acts in a batch")
        shown = {name: array[PLACE].tobytes() for name, array in seen.items()}
        _require(shown == turn["seen"], f"turn {number}: an observation in a batch is the one alone")
        actions = [_choice(mask, 3 * number + b) for b, mask in enumerate(seen[ACTION_MASK])]
        actions[PLACE] = turn["action"]
        simulator.step(np.array(actions))
        same = simulator.reward[PLACE] == turn["reward"] and dict(_bits(simulator.snapshot(PLACE))) == turn["after"]
        _require(same, f"turn {number}: reward and state in a batch are those alone")


def _check_aec(problem: Problem, trace: Trace) -> None:
    from marl_sched.envs.api.aec import SchedulingAEC

    env = SchedulingAEC(
        problem.domain,
        scale=problem.pad,
        instance=problem.instances[0],
        view=problem.view,
        horizon=problem.horizon,
        objective=problem.objective,
        split="test",
    )
    env.reset(seed=problem.seed)
    for number, turn in enumerate(trace):
        _require(env.agent_selection == problem.domain.agent_name(turn["agent"]), f"turn {number}: AEC selects as here")
        observation = env.last()[0]
        arrays = {**observation["observation"], ACTION_MASK: observation[ACTION_MASK]}
        shown = {name: np.asarray(array).tobytes() for name, array in arrays.items()}
        _require(shown == turn["seen"], f"turn {number}: AEC shows the same observation")
        env.step(turn["action"])
        _require(env.rewards[env.agents[0]] == turn["reward"], f"turn {number}: AEC pays the same reward")
        _require(dict(_bits(env.simulator.snapshot(0))) == turn["after"], f"turn {number}: AEC goes to the same state")
    ended = [*env.terminations.values(), *env.truncations.values()]
    _require(any(ended), "AEC ends with the trace")


def _check_torchrl(problem: Problem, trace: Trace) -> None:
    import torch
    from torchrl.envs import step_mdp

    from marl_sched.envs.api.torchrl_env import SchedulingTorchRL

    env = SchedulingTorchRL(
        problem.domain,
        scale=problem.pad,
        instances=list(problem.instances),
        view=problem.view,
        horizon=problem.horizon,
        objective=problem.objective,
        seed=problem.seed,
        split="test",
    )
    state = env.reset()
    for number, turn in enumerate(trace):
        shown = {name: state[name][0].numpy().tobytes() for name in env.simulator.arrays}
        _require(shown == turn["seen"], f"turn {number}: TorchRL shows the same observation")
        state = step_mdp(env.step(state.set("action", torch.tensor([turn["action"]]))), exclude_reward=False)
        same = state["reward"][0].item() == turn["reward"]
        same = same and dict(_bits(env.simulator.snapshot(0))) == turn["after"]
        _require(same, f"turn {number}: TorchRL pays the same reward and goes to the same state")
    _require(bool(state["done"][0]), "TorchRL ends with the trace")


def _check_telemetry(problem: Problem) -> None:
    """What every agent makes of the messages on its channels is what the simulator shows it."""
    simulator, telemetry = problem.simulator(), problem.domain.telemetry
    if telemetry is None:
        return
    frame = telemetry.frame(simulator)
    known = [telemetry.local_state(frame, agent) for agent in range(int(simulator.n_agents[0]))]
    number, said, touched = 0, dict[str, bytes](), None
    while simulator.acting[0] >= 0:
        before, said = said, telemetry.messages(simulator)
        changed = {channel for channel, payload in said.items() if before.get(channel) != payload}
        _require(touched is None or changed <= touched, f"turn {number}: turn_channels are all that a turn can change")
        _require(
            telemetry.messages(simulator, changed) == {channel: said[channel] for channel in changed},
            f"turn {number}: of some channels messages says what it says of all",
        )
        for agent, state in enumerate(known):
            for channel in state.channels:
                if channel in said:
                    state.hear(channel, said[channel])
            if agent != simulator.acting[0]:
                continue
            seen, heard = simulator.observe(np.array([agent])), state.observe()
            for name, array in seen.items():
                same = array.tobytes() == np.asarray(heard[name]).tobytes()
                _require(same, f"turn {number}: agent {agent}: {name} from messages is the simulator's")
        possible = set(telemetry.turn_channels(simulator, int(simulator.acting[0])))
        simulator.step(np.array([_choice(simulator.legal()[0], number)]))
        touched = None if simulator.elapsed[0] > 0 else possible
        number += 1


def _choice(mask: np.ndarray, number: int) -> int:
    """A legal action that depends on the mask and the number of the turn alone; every seventh turn nothing."""
    legal = np.flatnonzero(mask)
    return int(legal[(7 * number + 3) % len(legal)]) if number % 7 else 0


def _bits(snapshot: Mapping[str, np.ndarray]) -> Iterator[tuple[str, bytes]]:
    """A snapshot as bytes, field by field: the gaps between the fields of a record say nothing."""
    for name, array in snapshot.items():
        for field in array.dtype.names or ("",):
            yield f"{name}.{field}", np.ascontiguousarray(array[field] if field else array).tobytes()


def _copy(observation: Observation) -> Observation:
    return {name: array.copy() for name, array in observation.items()}


def _same(what: str, one: Trace, other: Trace) -> None:
    _require(len(one) == len(other), f"{what}: the same number of turns")
    for number, (first, second) in enumerate(zip(one, other, strict=True)):
        _require(first == second, f"{what}: turn {number} is the same")


def _require(good: bool, promise: str) -> None:
    if not good:
        raise ConformanceError(f"not so: {promise}")
