"""A proved upper bound on the expected M1 of AirME instances: the crews' constraint relaxed at a price.

AirME is weakly coupled: planes are decision processes of their own (marl_sched.agents.airme.bound.plane) that
share nothing but crews. Let a scheduler use K_t crews in hour t, at most C. For any prices pi_t >= 0

    E[return] <= E[return + sum_t pi_t (C - K_t)] = C sum_t pi_t + sum over planes of E[return_p - sum_t pi_t K_t,p]
              <= C sum_t pi_t + sum over planes of V_p(pi)

where V_p is the optimum of plane p's own process, in which it buys crew-hours at the prices. This holds for
every scheduler, also for one that knows the failure model, the clock and all planes; not for one that knows
future noise. It is convex in pi and is minimised over prices that are constant within segments of the episode;
wherever the minimisation stops, the value is a bound.

What is approximated, and on which side it errs (all upwards):
- V_p is convex in the plane's income, being a maximum of linear functions, and is interpolated between
  `nodes` incomes per type: the chord lies above. With as many nodes as planes of the type it is exact.
- Counters beyond HOURS_CAP and LANDINGS_CAP count as planes that never fail again. From the published
  starts such counters are reached by planes that are past all failures anyway, or with negligible probability.
- Relaxed are the crews' number in every realisation (it holds on average only, and only as far as the prices
  enforce it) and nothing else: hours, missions, recalls, repairs and the end of the episode are exact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from marl_sched.agents.airme.bound.plane import (
    BROKEN,
    HOURS_CAP,
    LANDINGS_CAP,
    PlaneModel,
    expected_crew_hours,
    plane_model,
    reward_of,
    solve,
)
from marl_sched.envs.airme.aircraft import FailureModel
from marl_sched.envs.airme.instance import AirmeInstance
from marl_sched.envs.airme.state import OBJECTIVES
from marl_sched.errors import InvalidOptionError, UnknownNameError

# Prices may change at these hours from the start and from the end: crews are short while the initial backlog
# lasts, and worth nothing when no repair pays any more.
AFTER_START = (0, 3, 6, 9, 12, 15, 18, 21, 24, 30, 36, 48, 60, 72, 96, 168)
BEFORE_END = (48, 24)
FIRST_GUESS = 0.6, 12.0  # of what a crew's planes earn in an hour at hour 0, and hours in which it falls e-fold
NODES = 6


def price_segments(horizon: int) -> np.ndarray:
    """The segment, int64 (T,), to which each hour's price belongs."""
    starts = {hour for hour in AFTER_START if hour < horizon / 2}
    starts |= {horizon - hour for hour in BEFORE_END if hour < horizon / 2}
    return np.searchsorted(sorted(starts), np.arange(horizon), side="right") - 1


@dataclass(frozen=True)
class _Group:
    """The planes of one type in all instances; N planes, J income nodes."""

    model: PlaneModel
    incomes: np.ndarray  # float64 (J,), nodes
    instance: np.ndarray  # int64 (N,)
    state: tuple[np.ndarray, np.ndarray, np.ndarray]  # int64 (N,) each: index into values at hour 0
    weight: np.ndarray  # float64 (N, J), how a plane's income is mixed of the nodes


class Relaxation:
    """The relaxed problem of a set of instances, all with the same aircraft types.

    Raises UnknownNameError for an unknown objective, InvalidOptionError for differing types.
    """

    def __init__(
        self,
        instances: Sequence[AirmeInstance],
        *,
        objective: str = "profit",
        horizon: int = 720,
        failure: FailureModel = "density",
        nodes: int = NODES,
    ) -> None:
        if objective not in OBJECTIVES:
            raise UnknownNameError("objective of airme", objective, OBJECTIVES)
        if any(instance.types != instances[0].types for instance in instances):
            raise InvalidOptionError("instances: a bound needs instances with the same aircraft types")
        if horizon < 1 or nodes < 2:
            raise InvalidOptionError(f"horizon and nodes: expected at least 1 and 2, got {horizon} and {nodes}")
        self.objective, self.horizon = objective, horizon
        self.crews = np.array([instance.n_crews for instance in instances], np.float64)
        share = [i.n_planes if objective == "availability" else i.income.sum() for i in instances]
        self.scale = np.array(share, np.float64) * horizon  # what M1 is divided by
        self._groups = [_group(instances, k, objective, failure, nodes) for k in range(len(instances[0].types))]
        self._policy = np.zeros((0, BROKEN + 1, LANDINGS_CAP + 1, HOURS_CAP + 1), np.uint8)

    def bounds(self, prices: np.ndarray) -> np.ndarray:
        """An upper bound on every instance's expected M1, float64 (N,), at prices float64 (T,) >= 0."""
        return self._evaluate(prices, None)[0]

    def mean_and_slope(self, prices: np.ndarray, instances: np.ndarray) -> tuple[float, np.ndarray]:
        """The mean bound of some instances, bool (N,), and its derivative by each hour's price, float64 (T,)."""
        weight = instances / self.scale / instances.sum()
        bounds, crew_hours = self._evaluate(prices, weight)
        return float(bounds[instances].mean()), (weight @ self.crews) - crew_hours

    def _evaluate(self, prices: np.ndarray, weight: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Bounds, float64 (N,), and crew-hours used, float64 (T,), in which instances count by `weight`."""
        prices = np.asarray(prices, np.float64)
        if prices.shape != (self.horizon,) or not (prices >= 0).all():
            raise InvalidOptionError(f"prices: expected {self.horizon} numbers >= 0")
        if weight is not None and not len(self._policy):
            self._policy = np.zeros((self.horizon, *self._policy.shape[1:]), np.uint8)
        policy = self._policy if weight is not None else self._policy[:0]
        total = self.crews * prices.sum()
        used = np.zeros(self.horizon)
        for group in self._groups:
            for node, income in enumerate(group.incomes):
                value, _ = solve(group.model, reward_of(self.objective, income), prices, policy)
                shares = group.weight[:, node]
                total += np.bincount(group.instance, shares * value[group.state], len(total))
                if weight is not None:
                    mass = np.zeros_like(value)
                    np.add.at(mass, group.state, shares * weight[group.instance])
                    used += expected_crew_hours(group.model, policy, mass)
        return total / self.scale, used

    def minimise(
        self, instances: np.ndarray | None = None, *, start: np.ndarray | None = None, evaluations: int = 14
    ) -> np.ndarray:
        """Prices, float64 (T,), that make the mean bound of some instances, bool (N,), small.

        L-BFGS-B on one price per segment; `start` float64 (T,) gives the first ones. It stops when the mean
        hardly falls any more or after so many evaluations.
        """
        chosen = np.ones(len(self.scale), bool) if instances is None else np.asarray(instances, bool)
        segment = price_segments(self.horizon)
        first = np.r_[True, np.diff(segment) > 0]
        worth = (self.scale / self.crews)[chosen].mean() / self.horizon  # what a crew serves, per hour
        share, decay = FIRST_GUESS
        guess = share * worth * np.exp(-np.flatnonzero(first)[segment] / decay)
        prices = np.where(guess > 0.01 * worth, guess, 0.0) if start is None else np.asarray(start, np.float64)

        def mean_and_slope(x: np.ndarray) -> tuple[float, np.ndarray]:
            mean, slope = self.mean_and_slope(x[segment] * worth, chosen)
            return mean, np.bincount(segment, slope) * worth

        options = {"maxfun": evaluations, "ftol": 3e-6, "gtol": 0.0}
        bounds = [(0.0, None)] * int(first.sum())
        x0 = prices[first] / worth
        found = minimize(mean_and_slope, x0, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        return np.asarray(found.x)[segment] * worth


def _group(instances: Sequence[AirmeInstance], k: int, objective: str, failure: FailureModel, nodes: int) -> _Group:
    owner = np.concatenate([np.full(i.n_planes, n)[i.kind == k] for n, i in enumerate(instances)])
    hours, landings, broken, income = (
        np.concatenate([getattr(i, name)[i.kind == k] for i in instances])
        for name in ("hours", "landings", "broken", "income")
    )
    distinct = np.unique(income)
    if objective == "availability" or not len(distinct):
        incomes = np.ones(min(1, len(distinct)))
    elif len(distinct) <= nodes:
        incomes = distinct
    else:
        incomes = np.geomspace(distinct[0], distinct[-1], nodes)
        incomes[[0, -1]] = distinct[[0, -1]]
    weight = np.ones((len(income), 1))
    if len(incomes) > 1:
        weight = np.array([np.interp(income, incomes, row) for row in np.eye(len(incomes))]).T
    state = (np.where(broken, BROKEN, 0), np.minimum(landings, LANDINGS_CAP + 1), np.minimum(hours, HOURS_CAP + 1))
    return _Group(plane_model(instances[0].types[k], failure, hours, landings), incomes, owner, state, weight)


@dataclass(frozen=True)
class UpperBounds:
    """Bounds on the expected M1 of instances; `value` float64 (N,), `prices` float64 (N, T) that prove them."""

    value: np.ndarray
    prices: np.ndarray


def upper_bounds(
    relaxation: Relaxation,
    *,
    price_vectors: int = 5,
    evaluations: int = 14,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> UpperBounds:
    """Bound every instance with the best of several price vectors.

    Instances with alike numbers of planes per crew share a price vector that is best for their mean, as the
    cost of a vector does not depend on how many instances it serves. With as many vectors as instances each has
    its own. `progress` is told how many of how many vectors are done.
    """
    n = len(relaxation.scale)
    load = relaxation.scale / relaxation.crews
    prices = np.zeros((n, relaxation.horizon))
    best = relaxation.bounds(prices[0])  # free crews: what nothing above should be worse than
    start = None
    groups = np.array_split(np.argsort(load, kind="stable"), min(price_vectors, n))
    for done, members in enumerate(groups):
        progress(done, len(groups))
        chosen = np.zeros(n, bool)
        chosen[members] = True
        start = relaxation.minimise(chosen, start=start, evaluations=evaluations)
        bounds = relaxation.bounds(start)
        prices[bounds < best] = start
        best = np.minimum(best, bounds)
    return UpperBounds(best, prices)
