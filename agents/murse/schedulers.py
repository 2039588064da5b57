"""The schedulers of MuRSE by name; they live in `marl_sched.agents.murse`."""

from __future__ import annotations

from collections.abc import Callable

from marl_sched.agents.base import Scheduler
from marl_sched.agents.murse.dispatching import factories
from marl_sched.agents.murse.genetic import GeneticEdf
from marl_sched.agents.murse.lst import BackwardLst, LeastLatestStart, LstSearch, RobustLst
from marl_sched.agents.murse.negotiated import Cbba, Tessi, TessiSlack
from marl_sched.agents.murse.optimal import ExactScheduler, RollingScheduler, is_feasible, solver_bound
from marl_sched.agents.murse.published import EdfPublished, GeneticPublished
from marl_sched.agents.murse.rollout import LatestStartRollout, LocalLst, RobustLocalLst, RobustRollout
from marl_sched.agents.murse.rules import FirstClaim, RandomRule, edf, hctf
from marl_sched.agents.murse.tercio import Tercio

IS_FEASIBLE = is_feasible
SOLVER_BOUND = solver_bound

RULES: dict[str, Callable[..., Scheduler]] = {
    "random": RandomRule,
    "edf": edf,
    "edf-published": EdfPublished,
    "hctf": hctf,
    **factories(),
    "lst": LeastLatestStart,
    "lst-robust": RobustLst,
    "lst-backward": BackwardLst,
    "lst-search": LstSearch,
    "first-claim": FirstClaim,
    "tessi": Tessi,
    "tessi-slack": TessiSlack,
    "cbba": Cbba,
    "genetic-edf": GeneticEdf,
    "genetic-published": GeneticPublished,
    "tercio": Tercio,
    "lst-local": LocalLst,
    "lst-robust-local": RobustLocalLst,
    "lst-rollout": LatestStartRollout,
    "lst-robust-rollout": RobustRollout,
    "exact": ExactScheduler,
    "exact-rolling": RollingScheduler,
}
