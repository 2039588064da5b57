"""What every domain's simulator offers: a batch of instances, each a process in which agents take turns.

At each decision epoch every unfinished row has one acting agent. Action 0 always means "do nothing" and is always
legal. Agents that are free at the same simulated decision epoch act in turn, each seeing what its view lets it see
of the earlier choices; when none is left, simulated time passes until an agent is free again.
Rows never influence each other. All arrays lead with the batch axis B.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from marl_sched.errors import IllegalActionError, InvalidOptionError
from marl_sched.graph import ACTION_MASK, ArraySpec, GraphSpec
from marl_sched.noise import Stream, as_seed, episode_key, uniforms

if TYPE_CHECKING:
    from marl_sched.domain_parts import CentralInterface

Observation = dict[str, np.ndarray]
_POLICY = int(Stream.POLICY)  # a compiled function takes fifteen times as long to recognise an IntEnum


@dataclass(frozen=True)
class SavedState:
    """Where a simulator stands: copies, to which it can return any number of times (`TurnSimulator.load_state`).

    Attributes:
        kind: class of the simulator that saved it.
        arrays: copies of the simulator's `live_arrays`.
        instances: the instances being played; they never change and are not copied.
    """

    kind: str
    arrays: Mapping[str, np.ndarray]
    instances: tuple[Any, ...]


class TurnSimulator(ABC):
    """A batch of instances in which agents take turns; see the module's page.

    Attributes (all shapes with B = `batch`):
        batch: number of rows.
        instances: the instance of each row.
        view: what acting agents see, an instance of one of the domain's views; its `kind` is the view's name;
            its `hides` says whether there is anything that some agent does not see.
        max_agents, max_actions: padded sizes; actions are 0..max_actions-1.
        n_agents: int64 (B,), agents of each row's instance.
        acting: int64 (B,), the agent to act, -1 where nobody is to act because the episode is over.
        time: int64 (B,), simulated time (AirME: hours, MuRSE: time units).
        reward: float64 (B,), team reward of the time the last step let pass; 0 while others act at the decision epoch.
        elapsed: int64 (B,), simulated time that the last step let pass.
        conflict: bool (B,), the last choice was legal in the agent's view and impossible in truth.
        terminated, truncated: bool (B,), how the episode ended, false while it runs.
        episode_keys: uint64 (B,), counter-based randomness of the running episodes (marl_sched.noise).
        unit: what the length of an episode is counted in, in the plural; as `Domain.unit`, such as "hours", "rounds".
        time_unit: what `time` and `elapsed` count, in the plural; mostly the same.
        horizon: length of an episode in `unit`, at most.
        graph: the metagraph of the observations.
        arrays: name -> ArraySpec of the observation's arrays.
    """

    batch: int
    instances: list[Any]
    view: Any
    max_agents: int
    max_actions: int
    n_agents: np.ndarray
    acting: np.ndarray
    time: np.ndarray
    reward: np.ndarray
    elapsed: np.ndarray
    conflict: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    episode_keys: np.ndarray
    unit: str
    time_unit: str
    horizon: int
    graph: GraphSpec
    arrays: Mapping[str, ArraySpec]
    _observed: Observation | None = None  # the arrays of observe_acting
    _seeds: np.ndarray  # int64 (B,), see _first_episodes
    _episodes: np.ndarray  # int64 (B,), the number of each row's episode under its seed

    @abstractmethod
    def reset(
        self,
        envs: np.ndarray | None = None,
        *,
        seed: int | None = None,
        instances: Sequence[Any] | None = None,
        episodes: Sequence[int] | None = None,
    ) -> None:
        """Start a new episode in `envs` (bool (B,), all if None).

        With a seed the rows start episode 0 of that seed, without one the next episode of theirs; `episodes`,
        one number for each chosen row in order, says otherwise (rows that share an instance need it).
        `instances`, likewise, replace the rows' instances.
        """

    def _first_episodes(self) -> None:
        """Let every row stand before episode 0 of seed 0; a domain calls it once, before its first reset."""
        self._seeds, self._episodes = np.zeros(self.batch, np.int64), np.full(self.batch, -1, np.int64)

    def _next_episodes(
        self,
        envs: np.ndarray | None,
        seed: int | None,
        instances: Sequence[Any] | None,
        episodes: Sequence[int] | None,
    ) -> np.ndarray:
        """Check the arguments of `reset`, go on to the episodes that they name, and return their rows, int64 (N,).

        Raises InvalidOptionError for a seed outside [0, 2**63) and for other than one instance or number for each row.
        """
        rows = np.arange(self.batch) if envs is None else np.flatnonzero(envs)
        for name, given in (("instances", instances), ("episodes", episodes)):
            if given is not None and len(given) != len(rows):
                raise InvalidOptionError(f"{name}: expected one per chosen row ({len(rows)}), got {len(given)}")
        if seed is None:
            self._episodes[rows] += 1
        else:
            self._seeds[rows], self._episodes[rows] = as_seed(seed), 0
        if episodes is not None:
            self._episodes[rows] = episodes
        return rows

    def _episode_key(self, b: int) -> np.uint64:
        """Names the noise of row b's episode (marl_sched.noise)."""
        seed, episode = np.uint64(self._seeds[b]), np.uint64(self._episodes[b])
        return np.uint64(episode_key(seed, np.uint64(self.instances[b].identity), episode))

    @abstractmethod
    def step(self, actions: np.ndarray) -> None:
        """Apply the acting agents' choices, int64 (B,), and go on to each row's next acting agent.

        Rows that are over ignore their action. An action that is impossible in truth idles the agent and
        sets `conflict`; whether it is legal in the agent's view is for the environment APIs to check.
        Raises IllegalActionError for an action outside [0, max_actions).
        """

    @abstractmethod
    def observe(self, agents: np.ndarray, out: Observation | None = None) -> Observation:
        """The graph that each row's agent, int64 (B,), sees now, written to `out` or to fresh arrays.

        A negative agent gives an empty graph in which only action 0 is legal. An agent that is busy or has
        acted at this decision epoch may do nothing but action 0.

        Raises InvalidOptionError for an agent from `max_agents` on and for arrays in `out` of other shapes than
        `new_observation` makes.
        """

    @abstractmethod
    def observe_all(self) -> Observation:
        """The graph under the full view with row's acting agent: the centralised information pattern."""

    def observe_acting(self) -> tuple[np.ndarray, Observation]:
        """What acting agents see: the rows that are not over, int64 (N,), and arrays of an observation with B = N.

        The arrays are the simulator's own and hold until the next call.
        """
        if self._observed is None:
            self._observed = self.new_observation()
        rows = np.flatnonzero(self.acting >= 0)
        observation = self.observe(self.acting, self._observed)
        if len(rows) < self.batch:
            observation = {name: values[rows] for name, values in observation.items()}
        return rows, observation

    @abstractmethod
    def free_agents(self, env_index: int) -> np.ndarray:
        """The agents, int64, that have still to act at this decision epoch in `env_index`, in turn order."""

    def give_turn(self, env_index: int, agent: int) -> None:
        """Let an agent that has still to act at this decision epoch act next; the others follow in turn order.

        Raises IllegalActionError for an agent that has no turn left.
        """
        if agent not in self.free_agents(env_index):
            raise IllegalActionError(f"row {env_index}: agent {agent} has no turn at time {self.time[env_index]}")
        self.acting[env_index] = agent

    def play_jointly(self, central: CentralInterface, action: Any) -> tuple[float, dict[str, Any]]:
        """Take all turns that a joint action covers in env 0; the reward it brought and the step's infos."""
        return central.play(self, action)

    @abstractmethod
    def objectives(self) -> dict[str, np.ndarray]:
        """The domain's measures of the running or finished episodes, name -> float64 (B,)."""

    def per_round(self) -> dict[str, np.ndarray]:
        """Measures of each round of an episode, name -> float64 (B, rounds), NaN where there is nothing to measure.

        Empty for domains whose episodes have no rounds.
        """
        return {}

    def agent_figures(self) -> dict[str, np.ndarray]:
        """What every agent did in the running or finished episodes: name -> float64 (B, max_agents).

        NaN for slots without an agent. `utilisation` is the share of time at work, `idle` the rest; the other figures
        are the domain's own. Empty for domains that count none.
        """
        return {}

    @property
    def length(self) -> np.ndarray:
        """Int64 (B,), the length of each env's episode in `unit` if nothing ends it early; the horizon, mostly."""
        return np.full(self.batch, self.horizon, np.int64)

    @property
    def progress(self) -> np.ndarray:
        """Int64 (B,), how many `unit`s of its episode have passed in each env, from 0 to `length`.

        It never falls within an episode. Whoever cuts episodes into pieces cuts by it; discounts use `elapsed`.
        """
        return self.time

    @property
    def progress_share(self) -> np.ndarray:
        """Float64 (B,), the share of its episode that has passed in each env; 1 where it is over."""
        return np.where(self.over, 1.0, self.progress / self.length)

    @property
    def reward_parts(self) -> Mapping[str, np.ndarray]:
        """The parts that the last step's `reward` is the sum of: name -> float64 (B,); empty where it has none."""
        return {}

    @property
    def presence(self) -> Mapping[str, np.ndarray]:
        """Node type -> bool (B, n), which padded slots hold a node now; types that are left out never change.

        Nodes come and go during an episode: work arrives and is cancelled, an agent joins and leaves. A node that
        is not there has a zero mask in every observation, is never acting and never legal to choose. A slot that
        stands for doing nothing is always present.
        """
        return {}

    @property
    def availability(self) -> Mapping[str, np.ndarray]:
        """Node type -> bool (B, n), which present nodes can be used now; types that are left out always can.

        An agent that is away for a while keeps its slot and its mask, and has no turn until it is back. A node type
        that is named here has the feature `available`, which holds this value wherever the node is visible.
        """
        return {}

    @abstractmethod
    def snapshot(self, env_index: int) -> dict[str, np.ndarray]:
        """Copies of all arrays of one row's true state, for traces, rendering and bit-equality tests."""

    def live_arrays(self) -> dict[str, np.ndarray]:
        """The arrays in which the running episodes stand, by name: what saving copies and loading writes to.

        By default every array that is an attribute or a field of the named tuple `state`. A domain that keeps its
        state elsewhere overrides this.
        """
        arrays = {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        state = getattr(self, "state", None)
        fields = getattr(state, "_fields", ())
        return arrays | {f"state.{name}": getattr(state, name) for name in fields}

    def save_state(self) -> SavedState:
        """A copy of where every episode of the batch stands, for lookahead and tree search."""
        arrays = {name: array.copy() for name, array in self.live_arrays().items()}
        return SavedState(type(self).__name__, arrays, tuple(self.instances))

    def load_state(self, saved: SavedState) -> None:
        """Go back to a saved state, of this simulator or of one that was made with the same options.

        Raises InvalidOptionError, and changes nothing, for a state of another kind or other sizes.
        """
        live = self.live_arrays()
        expected = {name: (array.shape, array.dtype) for name, array in live.items()}
        got = {name: (array.shape, array.dtype) for name, array in saved.arrays.items()}
        if saved.kind != type(self).__name__ or got != expected:
            raise InvalidOptionError(
                f"load_state: expected a state of {type(self).__name__} with the sizes of this simulator, "
                f"got one of {saved.kind}{_first_difference(expected, got)}"
            )
        for name, array in live.items():
            np.copyto(array, saved.arrays[name])
        self.instances[:] = saved.instances
        self._link()

    def __setstate__(self, attributes: dict[str, Any]) -> None:
        """Finish a copy made by `copy` or `pickle`: attributes that are views of other arrays become views again."""
        vars(self).update(attributes)
        self._link()

    def _link(self) -> None:
        """Set what follows from the state: attributes that are views of its arrays, caches of the instances.

        Called after the simulator was copied, unpickled or brought to a saved state. A domain whose attributes are
        views overrides it: copying an array severs its views.
        """

    def __repr__(self) -> str:
        """One line: `AirmeSimulator(2 envs of 720 hours, view local (reach 1, comm 1, staleness 0), at 24, 31)`."""
        from marl_sched.problem import view_in_words

        times = ", ".join(map(str, self.time[:3].tolist())) + (", ..." if self.batch > 3 else "")
        envs = f"{self.batch} env{'' if self.batch == 1 else 's'} of {self.horizon} {self.unit}"
        return f"{type(self).__name__}({envs}, view {view_in_words(self.view)}, at {times})"

    def new_observation(self) -> Observation:
        """Zeroed arrays of an observation for this batch, to pass as `out`."""
        return {name: spec.empty(self.batch) for name, spec in self.arrays.items()}

    def legal(self) -> np.ndarray:
        """The acting agents' action masks, int8 (B, max_actions)."""
        return self.observe(self.acting)[ACTION_MASK]

    def policy_noise(self, agents: np.ndarray, draw: int = 0) -> np.ndarray:
        """The uniform, float64 (B,), with which a sampling policy picks for these agents at this decision epoch."""
        return uniforms(self.episode_keys, self.time, _POLICY, np.maximum(agents, 0), draw)

    @property
    def over(self) -> np.ndarray:
        """Bool (B,), rows whose episode has ended."""
        return self.terminated | self.truncated


def _first_difference(expected: Mapping[str, Any], got: Mapping[str, Any]) -> str:
    """`: state.rows has shape (3,), expected (2,)` for the first array that differs, "" if none does."""
    for name in sorted(set(expected) | set(got)):
        if expected.get(name) != got.get(name):
            return f": {name} is {got.get(name, 'missing')}, expected {expected.get(name, 'none')}"
    return ""
