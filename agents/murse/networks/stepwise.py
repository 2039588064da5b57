"""What the networks share that build schedules step by step: how they learn and what plays them."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, cast

import numpy as np
import torch
from torch import Tensor, nn

from marl_sched.agents.murse.step_graph import SPEC, TASK
from marl_sched.agents.murse.step_learning import explored_steps, gathered_steps, played_schedule, steps_of
from marl_sched.agents.murse.step_planner import StepPlanner, Worths
from marl_sched.agents.networks.network import mask_logits
from marl_sched.agents.networks.planner import StepwiseNetwork
from marl_sched.agents.policies.cards import PolicyCard
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import ACTION_MASK, GraphSpec
from marl_sched.simulation import TurnSimulator

RULE_WEIGHT = 8.0  # at first, of a candidate's rank, from 0 for the first to nearly 1 for the last
_READ = frozenset(SPEC.arrays(dict.fromkeys(("task", "agent", "place"), 1))) - {"time", "visible_share"}


class StepGraphConfig:
    """What the sizes say, beside NetworkConfig, of a network that reads the graph of a schedule under construction."""

    __slots__ = ()

    @property
    def planner_options(self) -> tuple[str, ...]:
        """See NetworkConfig: those of StepPlanner."""
        return ("strategy", "look_ahead")

    def metagraph(self, graph: GraphSpec) -> GraphSpec:
        """See NetworkConfig: always that of marl_sched.agents.murse.step_graph."""
        return SPEC


class MurseStepNetwork(StepwiseNetwork):
    """A network that gives the tasks which an agent can start their worths.

    It corrects a rule: an untrained one chooses the task that has to start first by `backward_starts`, nearly always.

    Attributes:
        usual_candidates: beyond so many candidates a step between their ranks weighs as much as between so many.

    Args:
        spec: the metagraph.

    Raises InvalidOptionError for another metagraph than that of this version.
    """

    permutation_equivariant = True
    usual_candidates: ClassVar[float] = float("inf")

    def __init__(self, spec: GraphSpec) -> None:
        super().__init__()
        if spec != SPEC:
            raise InvalidOptionError("graph: expected that of marl_sched.agents.murse.step_graph in this version")
        self.spec = spec
        self.rule_weight = nn.Parameter(torch.tensor(RULE_WEIGHT))

    def corrected(self, values: Tensor, observation: Mapping[str, Tensor]) -> Tensor:
        """Worths (K, N + 2) from the network's corrections; the lowest finite number outside the action mask."""
        ranks = observation["task"][..., TASK.index("candidate_rank")].to(values.dtype)
        count = (observation[ACTION_MASK] != 0).sum(1, keepdim=True)
        weight = self.rule_weight * (count / self.usual_candidates).clamp(min=1.0).to(values.dtype)
        return mask_logits(values - weight * ranks, observation)

    def demonstration(self, simulator: TurnSimulator, row: int) -> np.ndarray:
        """See StepwiseNetwork."""
        return played_schedule(simulator, row)

    def steps(self, instance: Any, schedule: np.ndarray, discount: float) -> Mapping[str, np.ndarray]:
        """See StepwiseNetwork."""
        found = steps_of(instance, schedule, discount)
        return {name: array for name, array in found.items() if name in _READ or name in ("label", "return")}

    def gathered(self, steps: list[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """See StepwiseNetwork."""
        return gathered_steps([dict(each) for each in steps])

    def explored(self, instances: Sequence[Any], rng: np.random.Generator) -> dict[str, np.ndarray]:
        """See StepwiseNetwork."""
        found = explored_steps(instances, self._worths(), rng)
        return {name: array for name, array in found.items() if name in _READ or name == "costs"}

    def planner(self, name: str, card: PolicyCard | None, **options: Any) -> StepPlanner:
        """What plays a copy of the network on the CPU; options are StepPlanner's."""
        network = copy.deepcopy(self).cpu().requires_grad_(False)
        return StepPlanner(network._worths(), name, card, **options)

    @torch.inference_mode()
    def _worths(self) -> Worths:
        """The network on arrays, with its present parameters."""
        weights, device = self.weights(), next(self.parameters()).device

        @torch.inference_mode()
        def worths(arrays: dict[str, np.ndarray]) -> np.ndarray:
            tensors = {name: torch.from_numpy(array).to(device) for name, array in arrays.items() if name in _READ}
            return cast(np.ndarray, self(tensors, weights).cpu().numpy())

        return worths
