"""A policy's network as TorchRL has actors: a `ProbabilisticActor` over a masked categorical.

Its samples are counter-based: the environment puts the uniform into the tensordict, and the distribution picks by its
inverse. A run's choices are therefore the same whichever process samples them, in a batch of whatever size.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import InteractionType, TensorDictModuleBase
from torch import Tensor
from torchrl.modules import MaskedCategorical, ProbabilisticActor

from marl_sched.agents.base import inverse_distribution
from marl_sched.agents.networks.compaction import compacted
from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.graph import ACTION_MASK, TIME, VISIBLE_SHARE

LOG_PROB = "action_log_prob"


class CounterCategorical(MaskedCategorical):
    """A masked categorical that samples with given uniforms.

    Args:
        logits: float (..., n_actions).
        mask: (..., n_actions), nonzero where an action is legal.
        uniform: float64 (...), in [0, 1).
    """

    def __init__(self, logits: Tensor, *, mask: Tensor, uniform: Tensor) -> None:
        super().__init__(logits=logits, mask=mask != 0, neg_inf=torch.finfo(logits.dtype).min)
        self._uniform = uniform

    def sample(self, sample_shape: Iterable[int] = ()) -> Tensor:
        """Actions int64 (...): the first whose cumulated probability exceeds the uniform."""
        flat = self.logits.detach().flatten(0, -2).cpu().numpy()
        picked = inverse_distribution(flat, self._uniform.flatten().cpu().numpy())
        return torch.from_numpy(picked).view(self._uniform.shape).to(self.logits.device)


class Logits(TensorDictModuleBase):
    """A network that reads a tensordict's observation and writes `logits`, differentiably.

    Args:
        network: the policy's.
    """

    def __init__(self, network: PolicyNetwork) -> None:
        super().__init__()
        self.network = network
        sizes = {node.name: 1 for node in network.spec.nodes}
        self.in_keys: list[Any] = [name for name in network.spec.arrays(sizes) if name not in (TIME, VISIBLE_SHARE)]
        self.out_keys: list[Any] = ["logits"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write float (N, n_actions); the lowest finite number where an action is not legal."""
        return tensordict.set("logits", self._logits({name: tensordict.get(name) for name in self.in_keys}))

    def _logits(self, observation: Mapping[str, Tensor]) -> Tensor:
        return self.network(observation)


class ActingLogits(Logits):
    """The same for acting: without gradients, and without what nobody of a batch sees, where the network allows that.

    `prepare` works out once what depends on the parameters alone (PolicyNetwork.weights); it is to be called again
    whenever they have changed, or never, as in a worker whose parameters are changed from outside.
    """

    def __init__(self, network: PolicyNetwork) -> None:
        super().__init__(network)
        self._weights: Any = None

    @torch.inference_mode()
    def prepare(self) -> None:
        """Work out for the present parameters what all forward passes share."""
        self._weights = self.network.weights()

    @torch.inference_mode()
    def _logits(self, observation: Mapping[str, Tensor]) -> Tensor:
        if not self.network.permutation_equivariant:
            return self.network(observation, self._weights)
        visible, names = compacted(self.network.spec, observation)
        found = self.network(visible, self._weights)
        logits = found.new_full(observation[ACTION_MASK].shape, torch.finfo(found.dtype).min)
        return logits.scatter_(1, names, found)


def actor(module: Logits) -> ProbabilisticActor:
    """The actor that samples from a network's logits."""
    return ProbabilisticActor(
        module=module,
        in_keys={"logits": "logits", "mask": ACTION_MASK, "uniform": "uniform"},
        out_keys=["action"],
        distribution_class=CounterCategorical,
        default_interaction_type=InteractionType.RANDOM,
        return_log_prob=True,
        log_prob_key=LOG_PROB,
    )
