"""Proximal policy optimisation (dissertation, equation 6.8): TorchRL's `ClipPPOLoss` over the turns that count.

The loss is asked for its terms per sample, which our weights and masks then reduce.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from msgspec import Meta
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss

from marl_sched.agents.networks.compaction import compacted
from marl_sched.agents.networks.network import PolicyNetwork, RecurrentNetwork
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import ACTION_MASK
from marl_sched.train.actor import LOG_PROB, Logits, actor
from marl_sched.train.advantages import normalised
from marl_sched.train.bounds import Count, Group, NonNegative, Positive
from marl_sched.train.collect import Rollout
from marl_sched.train.device import device_of
from marl_sched.train.environment import CENTRAL
from marl_sched.train.estimators import TIME_LEFT, Estimate, seen_by_critic
from marl_sched.train.sequences import PLACE, SEQUENCE, minibatches, observed_by, own_sequences

VALUE_WEIGHT = 0.5


class PpoConfig(Group, frozen=True, kw_only=True):
    """Clipped surrogate optimisation (equation 6.8); learning rate and entropy bonus change linearly.

    A run that starts from a trained policy must not unlearn it by the errors of a new critic: for the share
    `critic_warmup` of its updates the policy stays as it is, and then learns `policy_rate` times as fast as the critic.

    `bptt` is for recurrent policies (marl_sched.train.sequences): through how many of an agent's own turns gradients
    flow back at most, None: through all that it has in an update.
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
    bptt: Count | None = None


@dataclass(frozen=True)
class UpdateReport:
    """Means over the minibatches of an update.

    Entropy (nats), KL divergence of new from old policy and the clipped share are those that TorchRL's loss reports,
    over samples without their weights.
    """

    policy_loss: float
    value_loss: float
    entropy: float
    kl: float
    clipped: float
    gradient: float


def importance_subsample(
    policy: PolicyNetwork,
    rollout: Rollout,
    loss_mask: Tensor,
    min_keep_prob: float,
    rng: np.random.Generator,
    bptt: int | None = None,
) -> tuple[TensorDict, Tensor, tuple[Tensor, Tensor]]:
    """Turns of a rollout as a flat TensorDict of compacted graphs, with weights.

    Turns outside `loss_mask`, bool (T, B), are left behind here, whatever they hold. Of the others a turn is
    kept with probability q = max(1 - p, min_keep_prob), p being the probability of what was chosen, and weighs 1 / q:
    where a policy is nearly certain (a crew that waits, hour after hour) there is little to learn, and
    the weights keep every sum's expectation. `min_keep_prob` 1 keeps all. Of a recurrent policy's turns whole
    sequences are kept, of at most `bptt` turns of an agent, with weight 0 for those outside `loss_mask`
    (marl_sched.train.sequences).

    Raises InvalidOptionError if none is kept.
    Returns the samples, the action that each decision node of theirs stands for, int64 (N, n_kept), and
    the turn and the row of the rollout that each comes from, int64 (N,) each.
    """
    more: dict[str, Tensor] = {}
    if isinstance(policy, RecurrentNetwork):
        whose = (rollout.agents, rollout.valid, rollout.boundary)
        turn, row, more[SEQUENCE], more[PLACE] = own_sequences(*whose, loss_mask, bptt)
        weight = loss_mask.float()
    else:
        certainty = torch.where(loss_mask, rollout.log_probs, 0.0).exp()
        keep = (1 - certainty).clamp(min_keep_prob, 1.0)
        kept = loss_mask & (torch.from_numpy(rng.random(loss_mask.shape)) < keep)
        turn, row = kept.nonzero(as_tuple=True)
        weight = 1 / keep
    if not len(row):
        raise InvalidOptionError(
            f"train: none of the {int(loss_mask.sum())} turns of an update that count was kept to learn from; expected "
            "more instances, longer segments (algorithm.turns) or a larger share of certain turns (min_keep_prob)"
        )
    observation, actions = _as_read(policy, rollout.data.select(*observed_by(policy))[row, turn].to_dict())
    data = {**observation, "uniform": rollout.data["uniform"][row, turn], "weight": weight[turn, row], **more}
    return TensorDict(data, batch_size=[len(row)]), actions, (turn, row)


def samples_of(
    policy: PolicyNetwork,
    rollout: Rollout,
    estimate: Estimate,
    min_keep_prob: float,
    rng: np.random.Generator,
    bptt: int | None = None,
) -> TensorDict:
    """Turns to learn from (`importance_subsample`), with what was chosen, normalised advantages and value targets."""
    samples, names, (turn, row) = importance_subsample(policy, rollout, estimate.loss_mask, min_keep_prob, rng, bptt)
    samples["action"] = (names == rollout.actions[turn, row][:, None]).int().argmax(1)
    samples[LOG_PROB] = rollout.log_probs[turn, row]
    advantages = normalised(estimate.advantages, estimate.loss_mask)[turn, row]
    samples["advantage"] = advantages.float()[:, None]
    if estimate.value_targets is not None:
        samples["value_target"] = estimate.value_targets[turn, row].float()[:, None]
        if rollout.data.get(CENTRAL, None) is not None:
            samples[CENTRAL], _ = compacted(policy.spec, rollout.data[CENTRAL][row, turn].to_dict())
        if rollout.data.get(TIME_LEFT, None) is not None:
            samples[TIME_LEFT] = rollout.data[TIME_LEFT][row, turn]
    return samples


def _as_read(network: PolicyNetwork, observation: Mapping[str, Tensor]) -> tuple[Mapping[str, Tensor], Tensor]:
    """Observations (N, ...) as small as the network can read them, and the actions' old names (see `compacted`)."""
    if network.permutation_equivariant:
        return compacted(network.spec, observation)
    actions = observation[ACTION_MASK].shape
    return observation, torch.arange(actions[1]).expand(actions)


class Values(TensorDictModuleBase):
    """A critic that reads a tensordict and writes `state_value`, float (N, 1), as TorchRL's losses ask it."""

    def __init__(self, critic: nn.Module) -> None:
        super().__init__()
        self.critic = critic
        self.in_keys: list[Any] = []
        self.out_keys: list[Any] = ["state_value"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the values."""
        return tensordict.set("state_value", self.critic(seen_by_critic(tensordict))[:, None])


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
        self.policy, self.config = policy, config
        self.modules: dict[str, nn.Module] = {"policy": policy} | ({"critic": critic} if critic is not None else {})
        self.loss = ClipPPOLoss(
            actor(Logits(policy)),
            None if critic is None else Values(critic),
            clip_epsilon=config.clip,
            entropy_coeff=config.entropy,
            critic_coeff=None if critic is None else VALUE_WEIGHT,
            loss_critic_type="l2",
            reduction="none",
            functional=False,
        )
        self.loss.loss_mask_key = None  # turns that do not count never become samples
        self.loss.set_keys(sample_log_prob=LOG_PROB)
        self.optimizer = torch.optim.Adam(
            [{"params": list(module.parameters())} for module in self.modules.values()], fused=True
        )

    def update(self, samples: TensorDict, progress: float, rng: np.random.Generator) -> UpdateReport:
        """Several epochs of minibatches; `progress` in [0, 1] places learning rate and entropy bonus."""
        config = self.config
        self.loss.entropy_coeff.fill_(between(config.entropy, config.final_entropy, progress))
        rate = between(config.learning_rate, config.final_learning_rate, progress)
        of_policy = 0.0 if progress < config.critic_warmup else config.policy_rate
        for name, group in zip(self.modules, self.optimizer.param_groups, strict=True):
            group["lr"] = rate * (of_policy if name == "policy" else 1.0)
        device = device_of(self.policy)
        on_device = samples.to(device)
        reports = [
            self._step(on_device[indices.to(device)])
            for indices in minibatches(samples, config.minibatch, config.epochs, rng)
        ]
        return UpdateReport(*means(reports))

    def _step(self, batch: TensorDict) -> Tensor:
        losses, share = self.loss(batch), batch["weight"] / batch["weight"].sum()
        terms = {name: share @ losses[name] for name in losses.sorted_keys if name.startswith("loss_")}
        self.optimizer.zero_grad()
        sum(terms.values()).backward()
        norms = [
            nn.utils.clip_grad_norm_(module.parameters(), self.config.max_grad_norm) for module in self.modules.values()
        ]
        self.optimizer.step()
        loss, value_loss = (terms.get(name, torch.zeros_like(norms[0])) for name in ("loss_objective", "loss_critic"))
        told = (losses[name] for name in ("entropy", "kl_approx", "clip_fraction"))
        return torch.stack([loss.detach(), value_loss.detach() / VALUE_WEIGHT, *told, norms[0]])


def means(reports: Sequence[Tensor]) -> list[float]:
    """The mean of each number of the minibatches' reports, float (n,) each, which a GPU hands over all at once."""
    return torch.stack(tuple(reports)).cpu().double().numpy().mean(axis=0).tolist()


def between(start: float, end: float, progress: float) -> float:
    """What changes linearly from start to end, at `progress` in [0, 1]."""
    return start + (end - start) * progress
