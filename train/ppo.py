"""Proximal policy optimisation (dissertation, equation 6.8) over turns of which only the valid ones count."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from msgspec import Meta
from tensordict import TensorDict
from torch import Tensor, nn

from marl_sched.agents.networks.compaction import compacted
from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.agents.policies.network_policy import inverse_distribution
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import ACTION_MASK
from marl_sched.train.advantages import normalised
from marl_sched.train.bounds import Count, Group, NonNegative, Positive
from marl_sched.train.collect import Rollout
from marl_sched.train.device import device_of
from marl_sched.train.estimators import Estimate

VALUE_WEIGHT = 0.5


class PpoConfig(Group, frozen=True, kw_only=True):
    """Clipped surrogate optimisation (equation 6.8); learning rate and entropy bonus change linearly.

    A run that starts from a trained policy must not unlearn it by the errors of a new critic: for the share
    `critic_warmup` of its updates the policy stays as it is, and then learns `policy_rate` times as fast as the critic.
    """

    clip: Positive
    epochs: Count
    minibatch: Count
    learning_rate: Positive
    final_learning_rate: NonNegative
    entropy: NonNegative
    final_entropy: NonNegative
    max_grad_norm: Positive
    min_keep_prob: Annotated[float, Meta(gt=0, le=1)]
    critic_warmup: Annotated[float, Meta(ge=0, lt=1)]
    policy_rate: Positive


@dataclass(frozen=True)
class UpdateReport:
    """Means over the minibatches of an update: entropy in nats, approximate KL divergence of new from old policy."""

    policy_loss: float
    value_loss: float
    entropy: float
    kl: float
    clipped: float
    gradient: float


class Sampler:
    """Samples a policy by inverse distribution, as an `Act` for collectors; see marl_sched.train.collect.

    Observations and choices are on the CPU, logits are computed where the network is.
    """

    def __init__(self, network: PolicyNetwork) -> None:
        self._network, self._device = network, device_of(network)
        with torch.inference_mode():
            self._weights = network.weights()

    @torch.inference_mode()
    def __call__(self, observation: dict[str, Tensor], uniform: np.ndarray) -> tuple[Tensor, Tensor]:
        """Actions int64 (B,) and log-probabilities float32 (B,)."""
        visible, names = _as_read(self._network, observation)
        there = {name: values.to(self._device) for name, values in visible.items()}
        log_probs = self._network(there, self._weights).log_softmax(-1).cpu()
        picked = torch.from_numpy(inverse_distribution(log_probs.numpy(), uniform))[:, None]
        return names.gather(1, picked).squeeze(1), log_probs.gather(1, picked).squeeze(1)


def importance_subsample(
    policy: PolicyNetwork, rollout: Rollout, loss_mask: Tensor, min_keep_prob: float, rng: np.random.Generator
) -> tuple[TensorDict, Tensor, Tensor]:
    """Turns of a rollout as a flat TensorDict of compacted graphs, with weights.

    Turns outside `loss_mask`, bool (T, B), are left behind here, whatever they hold. Of the others a turn is
    kept with probability q = max(1 - p, min_keep_prob), p being the probability of what was chosen, and weighs 1 / q:
    where a policy is nearly certain (a crew that waits, hour after hour) there is little to learn, and
    the weights keep every sum's expectation. `min_keep_prob` 1 keeps all.

    Raises InvalidOptionError if none is kept.
    Returns the samples, the action that each decision node of theirs stands for, int64 (N, n_kept), and
    the row of the flattened rollout (T B) that each comes from, int64 (N,).
    """
    certainty = torch.where(loss_mask, rollout.log_probs, 0.0).exp()
    keep = (1 - certainty).clamp(min_keep_prob, 1.0)
    rows = (loss_mask & (torch.from_numpy(rng.random(loss_mask.shape)) < keep)).flatten().nonzero().squeeze(1)
    if not len(rows):
        raise InvalidOptionError(
            f"train: none of the {int(loss_mask.sum())} turns of an update that count was kept to learn from; expected "
            "more instances, longer segments (algorithm.turns) or a larger share of certain turns (min_keep_prob)"
        )
    observation, names = _as_read(policy, _picked(rollout.observation, rows))
    data = {"observation": observation, "weight": (1 / keep).flatten()[rows]}
    return TensorDict(data, batch_size=[len(rows)]), names, rows


def samples_of(
    policy: PolicyNetwork, rollout: Rollout, estimate: Estimate, min_keep_prob: float, rng: np.random.Generator
) -> TensorDict:
    """Turns to learn from (`importance_subsample`), with what was chosen, normalised advantages and value targets."""
    samples, names, rows = importance_subsample(policy, rollout, estimate.loss_mask, min_keep_prob, rng)

    def pick(values: Tensor) -> Tensor:
        return values.flatten(0, 1)[rows]

    samples["target"] = (names == pick(rollout.actions)[:, None]).int().argmax(1)
    samples["log_prob"] = pick(rollout.log_probs)
    samples["advantage"] = pick(normalised(estimate.advantages, estimate.loss_mask)).float()
    if estimate.value_targets is not None:
        samples["value_target"] = pick(estimate.value_targets).float()
        if rollout.central is not rollout.observation:
            samples["central"], _ = compacted(policy.spec, _picked(rollout.central, rows))
    return samples


def _picked(columns: Mapping[str, Tensor], rows: Tensor) -> dict[str, Tensor]:
    """Rows, int64 (N,), of columns (T + 1, B, ...) laid out flat."""
    return {name: values.flatten(0, 1)[rows] for name, values in columns.items()}


def _as_read(network: PolicyNetwork, observation: Mapping[str, Tensor]) -> tuple[Mapping[str, Tensor], Tensor]:
    """Observations (N, ...) as small as the network can read them, and the actions' old names (see `compacted`)."""
    if network.permutation_equivariant:
        return compacted(network.spec, observation)
    actions = observation[ACTION_MASK].shape
    return observation, torch.arange(actions[1]).expand(actions)


def policy_loss(
    logits: Tensor, actions: Tensor, old_log_probs: Tensor, advantages: Tensor, clip: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Per sample: minus the clipped surrogate of equation 6.8, the probability ratio, and the entropy, (N,) each.

    logits float (N, n_actions), the lowest finite number where an action is not legal; the others (N,).
    """
    log_probs = logits.log_softmax(-1)
    ratio = (log_probs.gather(1, actions[:, None]).squeeze(1) - old_log_probs).exp()
    surrogate = torch.minimum(ratio * advantages, ratio.clamp(1 - clip, 1 + clip) * advantages)
    return -surrogate, ratio, -(log_probs.exp() * log_probs).sum(-1)


class Ppo:
    """The optimiser of a policy and, if there is one, its critic, with separate clipping of their gradients.

    Both are on one device, to which the samples of an update are brought at once.

    Args:
        policy: observation -> logits (N, n_actions).
        critic: central observation -> values (N,), or None.
        config: see PpoConfig.

    Raises InvalidOptionError if a critic that is not there is to learn alone.
    """

    def __init__(self, policy: PolicyNetwork, critic: nn.Module | None, config: PpoConfig) -> None:
        if critic is None and config.critic_warmup > 0:
            raise InvalidOptionError(
                f"ppo: critic_warmup: there is no critic to learn alone, got {config.critic_warmup}"
            )
        self.policy, self.critic, self.config = policy, critic, config
        self.modules: dict[str, nn.Module] = {"policy": policy} | ({"critic": critic} if critic is not None else {})
        self.optimizer = torch.optim.Adam(
            [{"params": list(module.parameters())} for module in self.modules.values()], fused=True
        )

    def update(self, samples: TensorDict, progress: float, rng: np.random.Generator) -> UpdateReport:
        """Several epochs of minibatches; `progress` in [0, 1] places learning rate and entropy bonus."""
        config = self.config
        entropy_weight = between(config.entropy, config.final_entropy, progress)
        rate = between(config.learning_rate, config.final_learning_rate, progress)
        of_policy = 0.0 if progress < config.critic_warmup else config.policy_rate
        for name, group in zip(self.modules, self.optimizer.param_groups, strict=True):
            group["lr"] = rate * (of_policy if name == "policy" else 1.0)
        device = device_of(self.policy)
        samples = samples.to(device)
        reports = [
            self._step(samples[indices.to(device)], entropy_weight)
            for indices in minibatches(samples.shape[0], config.minibatch, config.epochs, rng)
        ]
        return UpdateReport(*means(reports))

    def _step(self, batch: TensorDict, entropy_weight: float) -> Tensor:
        logits, share = self.policy(batch["observation"]), batch["weight"] / batch["weight"].sum()
        losses, ratio, entropies = policy_loss(
            logits, batch["target"], batch["log_prob"], batch["advantage"], self.config.clip
        )
        loss, entropy = share @ losses, share @ entropies
        total = loss - entropy_weight * entropy
        value_loss = torch.zeros_like(loss)
        if self.critic is not None:
            values = self.critic(batch.get("central", batch["observation"]))
            value_loss = share @ (values - batch["value_target"]).square()
            total = total + VALUE_WEIGHT * value_loss
        self.optimizer.zero_grad()
        total.backward()
        norms = [
            nn.utils.clip_grad_norm_(module.parameters(), self.config.max_grad_norm) for module in self.modules.values()
        ]
        self.optimizer.step()
        with torch.no_grad():
            kl = share @ ((ratio - 1) - ratio.log())
            clipped = share @ ((ratio - 1).abs() > self.config.clip).float()
            return torch.stack([loss, value_loss, entropy, kl, clipped, norms[0]])


def means(reports: Sequence[Tensor]) -> list[float]:
    """The mean of each number of the minibatches' reports, float (n,) each, which a GPU hands over all at once."""
    return torch.stack(tuple(reports)).cpu().double().numpy().mean(axis=0).tolist()


def between(start: float, end: float, progress: float) -> float:
    """What changes linearly from start to end, at `progress` in [0, 1]."""
    return start + (end - start) * progress


def minibatches(count: int, size: int, epochs: int, rng: np.random.Generator) -> Iterator[Tensor]:
    """Index tensors of at most about `size` samples each; every epoch visits every sample once."""
    parts = max(1, round(count / size))
    for _ in range(epochs):
        order = torch.from_numpy(rng.permutation(count))
        yield from order.tensor_split(parts)
