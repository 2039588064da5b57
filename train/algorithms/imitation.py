"""Imitation learning from a scheduler that can tell how good every choice is.

The policy that learns also plays, so that it meets its own mistakes (DAgger; Ross et al. 2011). In every state
that it comes to the teacher, which may know more (the true state of what the agent sees late or not at all,
the failure model), says what each choice is worth, A(a). The policy learns the distribution
softmax(A / temperature) over legal actions by cross-entropy: the colder, the finer the differences that it must
tell, and the surer the sign of a small advantage. That sign matters more than its size: a plane that is worth
a little now and left standing is left standing again an hour later.

Where the agent cannot see all that the teacher sees, that is a vote among choices it cannot tell apart. The other
criterion, for a policy that has learned by the first, maximises what its choice is worth on average,
sum over a of pi(a) A(a) + temperature x entropy (AggreVaTeD; Sun et al. 2017).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from marl_sched.agents.base import AdvantageScheduler
from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.agents.registry import create_scheduler
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import ACTION_MASK
from marl_sched.privileged import PrivilegedInfo
from marl_sched.train.algorithms.base import NAME, Setup
from marl_sched.train.algorithms.supervised import SupervisedConfig, SupervisedLearner
from marl_sched.train.bounds import Count, Positive
from marl_sched.train.collect import Collector, Rollout
from marl_sched.train.estimators import seen_by_critic
from marl_sched.train.learner import Learner
from marl_sched.train.ppo import between, importance_subsample

if TYPE_CHECKING:
    from marl_sched.train.config import TrainConfig

LEAST = -10.0  # no choice counts as worse than this, in units of what the best choice is usually worth


class ImitationConfig(SupervisedConfig, frozen=True, kw_only=True, tag_field=NAME, tag="imitation"):
    """Choices scored by a scheduler that knows more; temperature and learning rate change linearly.

    `criterion` is what is optimised: see the module's page.

    Rows play on from update to update, `turns` turns each, with the policy that learns.
    """

    instances: Count
    turns: Count
    teacher: str
    criterion: Literal["cross_entropy", "expected_advantage"]
    temperature: Positive
    final_temperature: Positive

    def build(self, setup: Setup) -> tuple[Collector, Learner]:
        """See AlgorithmConfig; raises InvalidOptionError for a scheduler that cannot teach."""
        teacher = create_scheduler(self.teacher, setup.config.env.name)
        if not isinstance(teacher, AdvantageScheduler):
            raise InvalidOptionError(
                f"train: algorithm.teacher: expected a scheduler that can tell how good every choice is, "
                f"got {self.teacher}"
            )
        if PrivilegedInfo.TIME_LEFT in teacher.privileged_info:  # training episodes are cut before the end it plans for
            raise InvalidOptionError(
                f"train: algorithm.teacher: expected a scheduler that does not heed the time left, got {self.teacher}"
            )
        collector = setup.segments(rows=self.instances, turns=self.turns, central=setup.hides)
        teacher.start(collector.env.simulator, np.ones(collector.env.simulator.batch, np.bool_))
        return collector, Imitation(setup.policy(collector.env), teacher, self)

    def knowledge(self, config: TrainConfig) -> list[str]:
        """The teacher's, and what it is shown."""
        teacher = create_scheduler(self.teacher, config.env.name)
        known = f" ({teacher.privileged_info})" if teacher.privileged_info else ""
        shown = ["the full graph for the teacher"] if config.make_view().hides else []
        return [f"imitation of {teacher.name}{known}", *shown]


class Imitation(SupervisedLearner):
    """Learns what a teacher would choose.

    Args:
        policy: observation -> logits (N, n_actions).
        teacher: started on the simulator of the rollouts.
        config: see ImitationConfig.
    """

    figures = ("regret", "entropy")

    def __init__(self, policy: PolicyNetwork, teacher: AdvantageScheduler, config: ImitationConfig) -> None:
        super().__init__(policy, config)
        self._teacher, self._config = teacher, config
        self._scale: float | None = None

    def learn(self, rollout: Rollout, progress: float, rng: np.random.Generator) -> dict[str, float]:
        """Ask the teacher about every turn that is kept, then take gradient steps.

        Raises InvalidOptionError for a teacher that prefers nothing in the first update.
        """
        return self.fit(self._samples(rollout, rng), progress, rng)

    def _samples(self, rollout: Rollout, rng: np.random.Generator) -> TensorDict:
        samples, names, (turn, row) = importance_subsample(
            self.policy, rollout, rollout.valid, self._config.min_keep_prob, rng
        )
        truth = {name: values.numpy() for name, values in seen_by_critic(rollout.data)[row, turn].items()}
        advantages = self._teacher.advantages(truth)
        if self._scale is None:
            self._scale = self._usual(advantages)
        scaled = torch.from_numpy(np.maximum(advantages / self._scale, LEAST)).float()
        # An action that the agent may choose but that is taken in truth costs it the hour: as much as waiting.
        scaled = torch.where(torch.from_numpy(truth[ACTION_MASK] != 0), scaled, 0.0)
        samples["advantage"] = scaled.gather(1, names)
        return samples

    def _usual(self, advantages: np.ndarray) -> float:
        """What the best choice is worth on average, of advantages (N, n_actions): the unit of a run's temperatures."""
        usual = float(advantages.max(axis=1).mean())
        if usual <= 0.0:
            raise InvalidOptionError(
                f"algorithm.teacher: to {self._teacher.name} no choice of the first update's {len(advantages)} turns "
                f"is worth more than doing nothing; expected a teacher that prefers something, or more turns"
            )
        return usual

    def _losses(self, batch: TensorDict, log_probs: Tensor, progress: float) -> Tensor:
        temperature = between(self._config.temperature, self._config.final_temperature, progress)
        if self._config.criterion == "cross_entropy":
            return cross_entropy(log_probs, (_legal_advantages(batch) / temperature).softmax(-1))
        return -expected_advantage(log_probs, batch["advantage"], temperature)

    def _figures(self, batch: TensorDict, log_probs: Tensor) -> list[Tensor]:
        probs = log_probs.exp()
        regret = _legal_advantages(batch).max(1).values - (probs * batch["advantage"]).sum(-1)
        return [regret, cross_entropy(log_probs, probs)]

    def state(self) -> dict[str, float | None]:
        """The scale of advantages."""
        return {"scale": self._scale}

    def restore(self, state: dict[str, float | None]) -> None:
        """The scale of advantages."""
        self._scale = state["scale"]


def _legal_advantages(batch: TensorDict) -> Tensor:
    return torch.where(batch[ACTION_MASK] != 0, batch["advantage"], -torch.inf)


def cross_entropy(log_probs: Tensor, wanted: Tensor) -> Tensor:
    """Of a policy relative to wanted distributions, both (N, n_actions), in nats, (N,).

    Actions that are not legal have the lowest finite log-probability and are wanted with probability 0.
    """
    return -(wanted * log_probs).sum(-1)


def expected_advantage(log_probs: Tensor, advantages: Tensor, temperature: float) -> Tensor:
    """The mean of finite advantages (N, n_actions) under a policy, and its entropy at a temperature, (N,)."""
    probs = log_probs.exp()
    return (probs * advantages).sum(-1) + temperature * cross_entropy(log_probs, probs)
