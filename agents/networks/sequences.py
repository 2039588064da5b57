"""Networks that plan by drawing whole sequences of choices, and so learn from what whole sequences cost.

Such a network reads the situations in which a simulator's rows stand, draws sequences for them, and has them played
(marl_sched.train.algorithms.greedy_rollout). What a situation is, is between the network and its domain.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from marl_sched.agents.networks.planner import PlannerNetwork
from marl_sched.agents.planning import TeamPlanner


class Drawn(NamedTuple):
    """S sequences for each of P situations, and what the network thought of them.

    Attributes:
        orders: int64 (P, S, N, k), the choices in order; behind a sequence's end zeros.
        log_probs: (P, S, L), of all choices up to the longest sequence's, 0 behind a sequence's end.
        entropies: (P, S), sums of the entropies of all choices.
        lengths: int64 (P,), numbers of choices.
        seen: what the network read on the way, to be given back with the same orders; None where it reads nothing.
        appraisals: float64 (P, S, L + 1), what a sequence costs if a rule completes it, before each choice and at the
            end; None: nobody asked.
    """

    orders: np.ndarray
    log_probs: Tensor
    entropies: Tensor
    lengths: np.ndarray
    seen: Any
    appraisals: np.ndarray | None


class SequenceNetwork(PlannerNetwork):
    """A planner's network whose plans are sequences of choices; see the page."""

    @abstractmethod
    def situations(self, simulator: Any, rows: np.ndarray) -> Any:
        """What rows, int64 (P,), of a simulator stand before."""

    @abstractmethod
    def selected(self, situations: Any, rows: np.ndarray) -> Any:
        """Some of the situations, int64 (K,), one as often as it is named."""

    @abstractmethod
    def choices(self, situations: Any) -> tuple[int, int]:
        """The longest sequence of choices, and how many random numbers each takes."""

    @abstractmethod
    def draw(
        self,
        situations: Any,
        samples: int = 1,
        *,
        uniforms: np.ndarray | None = None,
        given: np.ndarray | None = None,
        seen: Any = None,
        appraise: bool = False,
    ) -> Drawn:
        """Sequences for all situations: as given, drawn by uniforms, or greedy without either.

        given int64 (P, S, N, k), `seen` what was read when they were drawn; uniforms float64 (P, S, N, k) in [0, 1).
        `appraise` asks for appraisals, of sequences that are not given.
        """

    @abstractmethod
    def choice_log_probs(self, situations: Any, orders: np.ndarray, seen: Any) -> Tensor:
        """Log-probabilities of all choices that could be next along sequences, int64 (P, S, N, k): (P, S, L, M).

        The lowest finite number for those that cannot, and behind a sequence's end.
        """

    @abstractmethod
    def choice_costs(self, situations: Any, orders: np.ndarray) -> np.ndarray:
        """What sequences would cost if a rule completed them behind each of these choices, float64 (P, S, L, M).

        inf for what cannot be next.
        """

    @abstractmethod
    def selected_seen(self, seen: Any, rows: np.ndarray, samples: int) -> Any:
        """What was seen on the way of `samples` sequences for each of some of the situations, int64 (K,)."""

    @abstractmethod
    def planned(self, teacher: TeamPlanner[Any], simulator: Any, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sequences of another planner for rows, int64 (P, 1, N, k), and which of them are good, bool (P,)."""

    @abstractmethod
    def execute(self, simulator: Any, orders: np.ndarray) -> np.ndarray:
        """Play a sequence, int64 (B, N, k), in every row; what each costs, float64 (B,), less is better."""
