"""The index scheduler: serve the plane that gains most per crew-hour, by the bound's own computation.

A plane's index is the advantage of repairing it now over waiting an hour, in its own decision process
(marl_sched.agents.airme.bound.plane) at the relaxation's prices, divided by the expected hours of the repair
(after Whittle, "Restless bandits", 1988). A free crew serves the open plane with the largest positive index.

It sees what every rule sees, but knows the failure model and, unless told not to, the hours that remain.
Approximations, none of which touches the bound: indices are interpolated between a few incomes and hours, and
taken at price 0, which is the relaxation's price from the third day on. Prices of the first two days change the
ranking little, and a crew that idles because its hour is dear gains nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np

from marl_sched.agents.airme.bound.plane import (
    BROKEN,
    HOURS_CAP,
    LANDINGS_CAP,
    Reward,
    index_slices,
    plane_model,
    reward_of,
)
from marl_sched.agents.airme.epochs import EpochPlayer
from marl_sched.agents.airme.ranking import INDEX, N_FEATURES, IndexTables, Ranking, rank_observation, ranking
from marl_sched.agents.base import AdvantageScheduler
from marl_sched.envs.airme.aircraft import PUBLISHED_TYPES, AircraftType, FailureModel
from marl_sched.envs.airme.simulator import DEFAULT_HORIZON, AirmeSimulator
from marl_sched.errors import InvalidOptionError
from marl_sched.privileged import PrivilegedInfo
from marl_sched.simulation import TurnSimulator

INCOMES = 5  # nodes between which indices are interpolated
# Hours before the end at which indices are computed: the farther off the end, the less it matters.
BEFORE_END = (1, 2, 4, 6, 8, 12, 16, 20, 24, 30, 36, 42, 48, 56, 64, 72, 84, 96, 120, 160, 200, 240)
FAR_FROM_THE_END = 360
_NO_FAILURES = np.zeros((1, 1, 1))


class IndexScheduler(AdvantageScheduler):
    """Serve the open plane with the largest positive advantage per crew-hour.

    Args:
        clock: whether it knows the remaining hours; if not, it acts as in the middle of a long episode.
        objective, horizon, types, failure: what it plans for until it is started on a simulator, whose own
            take their place.

    Tables are computed at the first choice; that takes seconds and some 100 MB. An observation of another number
    of types than it plans for raises InvalidOptionError.
    """

    def __init__(
        self,
        *,
        clock: bool = True,
        objective: str = "profit",
        horizon: int = DEFAULT_HORIZON,
        types: Sequence[AircraftType] = PUBLISHED_TYPES,
        failure: FailureModel = "density",
    ) -> None:
        self.name = "index" if clock else "index-without-clock"
        self.privileged_info = PrivilegedInfo.FAILURE_MODEL | (
            PrivilegedInfo.TIME_LEFT if clock else PrivilegedInfo.NONE
        )
        self._clock = clock
        self._problem = (objective, horizon, tuple(types), failure)
        self._ranking: Ranking | None = None

    def start(self, simulator: TurnSimulator, envs: np.ndarray) -> None:
        """Plan for the simulator's objective, horizon, types and failure model."""
        of = cast(AirmeSimulator, simulator)
        problem = (of.objective, of.horizon, of.types, of.failure)
        if problem != self._problem:
            self._problem, self._ranking = problem, None

    def choose(self, observation: Mapping[str, np.ndarray], uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,); `uniform` is not used."""
        return self.advantages(observation).argmax(axis=1)

    def advantages(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """What each action gains per crew-hour over doing nothing, float64 (B, n_actions), in units of the objective.

        0 for doing nothing, -inf for an action that is not legal or whose plane will not fail any more.
        """
        require_types(self.name, observation["plane"].shape[-1] - N_FEATURES, self._problem[2])
        gains = rank_observation(observation, _NO_FAILURES, self._plan())
        gains[:, 0] = 0.0
        return gains

    def epoch_player(self, simulator: TurnSimulator) -> EpochPlayer:
        """What plays this scheduler's decision epochs in one call."""
        return EpochPlayer(cast(AirmeSimulator, simulator), self._plan())

    def _plan(self) -> Ranking:
        if self._ranking is None:
            self._ranking = ranking(INDEX, least=0.0, tables=index_tables(*self._problem, clock=self._clock))
        return self._ranking


def require_types(scheduler: str, seen: int, types: Sequence[AircraftType]) -> None:
    """Raise InvalidOptionError if an observation tells apart another number of types than a scheduler knows."""
    if seen != len(types):
        raise InvalidOptionError(
            f"{scheduler}: its failure model knows {len(types)} aircraft types "
            f"({', '.join(kind.name for kind in types)}), the observation has {seen}"
        )


def index_tables(
    objective: str, horizon: int, types: Sequence[AircraftType], failure: FailureModel, *, clock: bool
) -> IndexTables:
    """Indices of all types on a grid of hours, incomes and states.

    More than FAR_FROM_THE_END hours before the end an index no longer depends on the hour, so that the induction
    starts there.
    """
    length = min(horizon, FAR_FROM_THE_END)
    before_end = [hour for hour in (*BEFORE_END, length) if hour <= length] if clock else [length]
    hours = np.unique(length - np.array(before_end))
    nodes = 1 if objective == "availability" else INCOMES
    incomes = np.array([np.geomspace(*kind.income, nodes) for kind in types])
    states = (BROKEN + 1, LANDINGS_CAP + 1, HOURS_CAP + 1)
    values = np.zeros((len(types), nodes, len(hours), *states), np.float32)
    models = [plane_model(kind, failure, *_usual_starts()) for kind in types]
    for k, model in enumerate(models):
        for node, income in enumerate(incomes[k]):
            reward = Reward(*map(float, reward_of(objective, float(income))))
            index_slices(model, reward, np.zeros(length), hours, values[k, node])
    first, last = np.array([m.first for m in models]), np.array([m.last for m in models])
    return IndexTables(values, incomes, hours + (horizon - length), first, last)


def _usual_starts() -> tuple[np.ndarray, np.ndarray]:
    """Hours and landings, int64 (N,), of every plane that the generator can draw."""
    pairs = [(h, n) for h in range(121) for n in range(max(0, h // 10 - 2), h // 5 + 3)]
    starts = np.array(pairs, np.int64).T
    return starts[0], starts[1]
