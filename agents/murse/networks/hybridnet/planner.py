"""HybridNet and the interactive HetGAT as policies: how they read simulators, learn, and plan rounds.

The scheduler is section 5.5.3's ensemble: of every policy the greedy schedule and sampled ones, and the schedule of the
round before, are timed on the durations that the team believes; the best one is followed.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from msgspec import Struct
from torch import Tensor

from marl_sched.agents.base import EpochPlayer
from marl_sched.agents.murse.following import PlanningScheduler
from marl_sched.agents.murse.networks.hybridnet.decoding import AGENT, TASK, costs_along, draw_pairs, pair_log_probs
from marl_sched.agents.murse.networks.hybridnet.encoder import METAGRAPH
from marl_sched.agents.murse.networks.hybridnet.features import Features, take_features
from marl_sched.agents.murse.networks.hybridnet.network import Interactive, PairNetwork, Propagator
from marl_sched.agents.murse.networks.hybridnet.rounds import (
    Charges,
    Rounds,
    nothing_dispatched,
    present_rounds,
    schedule_costs,
    time_rows,
)
from marl_sched.agents.murse.networks.hybridnet.selectors import Residual
from marl_sched.agents.murse.problem import Plan, timed
from marl_sched.agents.murse.rollout import COMPACT_CHARGE, INFEASIBLE_CHARGE, LATE_CHARGE
from marl_sched.agents.murse.snapshot import as_murse, estimated_round
from marl_sched.agents.murse.whole_rounds import round_player
from marl_sched.agents.networks.planner import TrainedPlanner
from marl_sched.agents.networks.registry import NAME, NetworkConfig
from marl_sched.agents.networks.sequences import Drawn, SequenceNetwork
from marl_sched.agents.planning import TeamPlanner
from marl_sched.agents.policies.cards import Heads, Layers, PolicyCard, Width
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.state import NOBODY
from marl_sched.errors import InvalidOptionError, require_integer
from marl_sched.graph import GraphSpec
from marl_sched.simulation import TurnSimulator

LEARNED = Charges(LATE_CHARGE, INFEASIBLE_CHARGE, COMPACT_CHARGE)  # as in `lst-rollout`
PLANNED = Charges(LATE_CHARGE, 0.0, 0.0)
MOST_ROWS = 512  # schedules that are drawn at once
INFEASIBLE = 1e12  # what makes any feasible schedule the better one


class PairSequences(SequenceNetwork):
    """A network of pairs as one that draws whole schedules; see SequenceNetwork."""

    permutation_equivariant = True

    def __init__(self, spec: GraphSpec, config: NetworkConfig, pairs: PairNetwork) -> None:
        if spec != METAGRAPH:
            raise InvalidOptionError(f"policy {config.network_name()}: expected the metagraph of rounds of murse")
        super().__init__()
        self.spec, self.config, self.pairs = spec, config, pairs

    def forward(self, observation: Mapping[str, Tensor], weights: Any = None) -> Tensor:
        """What plans whole rounds has no use for one agent's observation: InvalidOptionError."""
        raise InvalidOptionError(f"policy {self.config.network_name()}: plans rounds and scores no observation")

    def planner(self, name: str, card: PolicyCard | None, **options: Any) -> RoundPlanner:
        """See PlannerNetwork; options are those of RoundPlanner."""
        return RoundPlanner([self], name=name, card=card, **options)

    def situations(self, simulator: MurseSimulator, rows: np.ndarray) -> Rounds:
        """See SequenceNetwork."""
        return present_rounds(simulator, rows)

    def selected(self, situations: Rounds, rows: np.ndarray) -> Rounds:
        """See SequenceNetwork."""
        return situations.take(rows)

    def choices(self, situations: Rounds) -> tuple[int, int]:
        """As many pairs as tasks, an agent and a task each."""
        return situations.shape[1], 2

    def draw(
        self,
        situations: Rounds,
        samples: int = 1,
        *,
        uniforms: np.ndarray | None = None,
        given: np.ndarray | None = None,
        seen: list[Features] | None = None,
        appraise: bool = False,
    ) -> Drawn:
        """See SequenceNetwork and `draw_pairs`."""
        return draw_pairs(self.pairs, situations, samples, uniforms=uniforms, given=given, seen=seen, appraise=appraise)

    def choice_log_probs(self, situations: Rounds, orders: np.ndarray, seen: list[Features] | None) -> Tensor:
        """See SequenceNetwork and `pair_log_probs`."""
        return pair_log_probs(self.pairs, situations, orders, seen)

    def choice_costs(self, situations: Rounds, orders: np.ndarray) -> np.ndarray:
        """See SequenceNetwork and `pair_costs`."""
        return costs_along(situations, orders)

    def selected_seen(self, seen: list[Features], rows: np.ndarray, samples: int) -> list[Features]:
        """See SequenceNetwork."""
        places = (rows[:, None] * samples + np.arange(samples)).ravel()
        return [take_features(features, places) for features in seen]

    def planned(
        self, teacher: TeamPlanner[Any], simulator: MurseSimulator, rows: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """See SequenceNetwork; plans in the order of their starts, feasible ones are good."""
        orders = np.zeros((len(rows), 1, simulator.state.tasks.shape[1], 2), np.int64)
        good = np.zeros(len(rows), np.bool_)
        for k, row in enumerate(rows.tolist()):
            plan: Plan = teacher.plan(simulator, row)
            good[k] = plan.feasible
            by_start = np.argsort(plan.starts[plan.tasks], kind="stable")
            orders[k, 0, : len(by_start), TASK] = plan.tasks[by_start]
            orders[k, 0, : len(by_start), AGENT] = plan.agents[by_start]
        return orders, good

    def execute(self, simulator: MurseSimulator, orders: np.ndarray) -> np.ndarray:
        """See SequenceNetwork; costs are those of `schedule_costs` on true times, charged as in `lst-rollout`."""
        rows = np.arange(simulator.batch)
        rounds, number = present_rounds(simulator, rows), simulator.state.rows["round"].copy()
        for row in rows.tolist():
            pairs = orders[row, : rounds.sizes[row, 0]]
            simulator.play_round(row, pairs[:, TASK], pairs[:, AGENT])
        finish = simulator.state.executed["finish"][rows, number]
        weighted = simulator.objective == "weighted"
        return np.asarray(schedule_costs(finish, rounds, weighted, LEARNED)[0])


class PairSizes(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Sizes that both networks have, and where their logits begin; see `PairNetwork`."""

    width: Width
    heads: Heads
    layers: Layers
    hidden: Width
    edge_width: Width
    residual: Residual

    def metagraph(self, graph: GraphSpec) -> GraphSpec:
        """That of rounds, whatever turns show."""
        return METAGRAPH

    def pair_sizes(self) -> dict[str, Any]:
        """The arguments of a PairNetwork."""
        return {name: getattr(self, name) for name in PairSizes.__struct_fields__}


class HybridNetConfig(
    PairSizes, NetworkConfig, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field=NAME, tag="hybridnet"
):
    """Sizes of HybridNet, and what goes beyond the dissertation; see `Propagator`."""

    timed: bool

    def build(self, graph: GraphSpec) -> PairSequences:
        """See NetworkConfig."""
        return PairSequences(graph, self, Propagator(**self.pair_sizes(), timed=self.timed))


class InteractiveConfig(
    PairSizes,
    NetworkConfig,
    frozen=True,
    kw_only=True,
    forbid_unknown_fields=True,
    tag_field=NAME,
    tag="hetgat_interactive",
):
    """Sizes of the interactive HetGAT; see `Interactive`."""

    def build(self, graph: GraphSpec) -> PairSequences:
        """See NetworkConfig."""
        return PairSequences(graph, self, Interactive(**self.pair_sizes()))


class RoundPlanner(PlanningScheduler, TrainedPlanner):
    """Plans every round by the best schedule of an ensemble; see the page.

    Args:
        networks: whose copies draw, on the CPU.
        name, card: of the first.
        samples: schedules of each network, the first one greedy.
        previous: whether the schedule of the round before competes.
        policies: further policies, by name or path, that draw as many.

    Raises InvalidOptionError for fewer than one sample, or a policy that does not plan rounds.
    """

    def __init__(
        self,
        networks: Sequence[PairSequences],
        *,
        name: str,
        card: PolicyCard | None,
        samples: int = 1,
        previous: bool = False,
        policies: Sequence[str] = (),
    ) -> None:
        super().__init__()
        self.name, self.card = name, card
        self.samples = require_integer("samples", samples, 1, 4096, "schedules")
        self._networks = [copy.deepcopy(network).cpu().requires_grad_(False) for network in networks]
        self._networks += [_network_of(policy) for policy in policies]
        self._previous: dict[int, np.ndarray] | None = {} if previous else None

    def best_of(self, samples: int) -> RoundPlanner:
        """The same with so many schedules of each network."""
        made = RoundPlanner(
            self._networks, name=f"{self.name}@samples={samples}", card=self.card, samples=samples,
            previous=self._previous is not None,
        )  # fmt: skip
        return made

    def start(self, simulator: TurnSimulator, envs: np.ndarray) -> None:
        """See PlanningScheduler; there is no round before."""
        super().start(simulator, envs)
        if self._previous is not None:
            for row in np.flatnonzero(envs).tolist():
                self._previous.pop(row, None)

    def plan(self, simulator: MurseSimulator, env_index: int) -> Plan:
        """The best schedule of a row's present round."""
        return self.plans(simulator, np.array([env_index]))[0]

    def plans(self, simulator: MurseSimulator, rows: np.ndarray) -> list[Plan]:
        """The best schedules of the present rounds of rows, int64 (K,)."""
        block, found = max(1, MOST_ROWS // self.samples), []
        for begin in range(0, len(rows), block):
            found += self._best_plans(simulator, rows[begin : begin + block])
        return found

    def _best_plans(self, simulator: MurseSimulator, rows: np.ndarray) -> list[Plan]:
        rounds = present_rounds(simulator, rows)
        candidates = np.concatenate(self._candidates(simulator, rows, rounds), axis=1)
        p, count = candidates.shape[:2]
        several = rounds.take(np.repeat(np.arange(p), count))
        partial = nothing_dispatched(several)
        time_rows(several, partial, candidates.reshape(p * count, -1, 2))
        costs, late, _ = schedule_costs(partial.finish, several, simulator.objective == "weighted", PLANNED)
        best = np.where(late > 0, costs + INFEASIBLE, costs).reshape(p, count).argmin(axis=1)
        plans = []
        for k, row in enumerate(rows.tolist()):
            pairs = candidates[k, best[k], : rounds.sizes[k, 0]]
            plans.append(timed(estimated_round(simulator, row), pairs[:, TASK], pairs[:, AGENT]))
            if self._previous is not None:
                self._previous[row] = candidates[k, best[k]]
        return plans

    def _candidates(self, simulator: MurseSimulator, rows: np.ndarray, rounds: Rounds) -> list[np.ndarray]:
        """Schedules to choose from, int64 (P, S, N, 2) each."""
        found, n = [], rounds.shape[1]
        uniforms = np.zeros((len(rows), self.samples - 1, n, 2))
        for k, row in enumerate(rows.tolist()):
            header = simulator.state.rows[row]
            rng = np.random.default_rng([int(header["episode"]), int(header["round"])])
            uniforms[k, :, : header["n_tasks"]] = rng.random((self.samples - 1, int(header["n_tasks"]), 2))
        with torch.inference_mode():
            for network in self._networks:
                found.append(network.draw(rounds).orders)
                if self.samples > 1:
                    found.append(network.draw(rounds, self.samples - 1, uniforms=uniforms).orders)
        if self._previous:
            found.append(
                np.stack([self._previous.get(row, found[0][k, 0]) for k, row in enumerate(rows.tolist())])[:, None]
            )
        return found

    def epoch_player(self, simulator: TurnSimulator) -> EpochPlayer | None:
        """Plays whole rounds, all rows planned in one batch, where nothing can be revised in between."""
        murse = as_murse(simulator)
        if round_player(murse, self.plan) is None:
            return None

        def play(count: int) -> tuple[float, int]:
            rows, decisions = np.flatnonzero(murse.acting != NOBODY), 0
            for row, plan in zip(rows.tolist(), self.plans(murse, rows), strict=True):
                murse.play_round(row, plan.tasks, plan.agents)
                decisions += len(plan.tasks)
            return float(decisions), decisions

        return play


def _network_of(policy: str) -> PairSequences:
    """The network of a policy by name or path; InvalidOptionError for one that does not plan rounds."""
    from marl_sched.agents.policies.checkpoint import load_network
    from marl_sched.agents.registry import policy_path

    network, _ = load_network(policy_path(policy))
    if not isinstance(network, PairSequences):
        raise InvalidOptionError(f"policies: {policy}: expected a policy that plans rounds of murse by pairs")
    return network.requires_grad_(False)
