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
from marl_sched.agents.networks.network import MEMORY, PolicyNetwork, RecurrentNetwork
from marl_sched.graph import ACTION_MASK
from marl_sched.train.environment import REMEMBERED
from marl_sched.train.sequences import PLACE, logits_of, observed_by

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

    A recurrent network reads decisions in sequences, in the order of `RecurrentNetwork.unroll` (marl_sched.train
    .sequences), and gradients flow through each sequence.

    Args:
        network: the policy's.
    """

    def __init__(self, network: PolicyNetwork) -> None:
        super().__init__()
        self.network = network
        self.in_keys: list[Any] = observed_by(network)
        if isinstance(network, RecurrentNetwork):
            self.in_keys.append(PLACE)
        self.out_keys: list[Any] = ["logits"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write float (N, n_actions); the lowest finite number where an action is not legal."""
        return tensordict.set("logits", logits_of(self.network, {name: tensordict.get(name) for name in self.in_keys}))


class ActingLogits(TensorDictModuleBase):
    """The same for acting: without gradients, and without what nobody of a batch sees, where the network allows that.

    With a recurrent network it also writes what the acting agents remember now, `remembered`.
    `prepare` works out once what depends on the parameters alone (PolicyNetwork.weights); it is to be called again
    whenever they have changed, or never, as in a worker whose parameters are changed from outside.

    Args:
        network: the policy's.
    """

    def __init__(self, network: PolicyNetwork) -> None:
        super().__init__()
        self.network = network
        self.in_keys: list[Any] = observed_by(network)
        self.out_keys: list[Any] = ["logits", REMEMBERED] if isinstance(network, RecurrentNetwork) else ["logits"]
        self._weights: Any = None

    @torch.inference_mode()
    def prepare(self) -> None:
        """Work out for the present parameters what all forward passes share."""
        self._weights = self.network.weights()

    @torch.inference_mode()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write float (N, n_actions); the lowest finite number where an action is not legal."""
        observation = {name: tensordict.get(name) for name in self.in_keys}
        for name, written in zip(self.out_keys, self._found(observation), strict=True):
            tensordict.set(name, written)
        return tensordict

    def _found(self, observation: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        if not self.network.permutation_equivariant:
            return self._pass(observation)
        visible, names = compacted(self.network.spec, observation)
        found, *others = self._pass(visible)
        logits = found.new_full(observation[ACTION_MASK].shape, torch.finfo(found.dtype).min)
        return logits.scatter_(1, names, found), *others

    def _pass(self, observation: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        if isinstance(self.network, RecurrentNetwork):
            return self.network.recur(observation, observation[MEMORY])
        return (self.network(observation, self._weights),)


def actor(module: Logits | ActingLogits) -> ProbabilisticActor:
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
