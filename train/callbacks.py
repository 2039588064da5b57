"""Hooks of a training run: what users of Python hang into the loop without changing it.

    class Print(Callback):
        def on_update(self, run: Run, values: Mapping[str, float]) -> None:
            print(values["update"], values["reward_rate"])

    train(load_config(["view=local"]), callbacks=[Print()])

Every hook does nothing unless a subclass says otherwise. The run's own log (marl_sched.train.logging) is a callback,
and `LoggerCallback` hands every number to one of TorchRL's loggers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from torchrl.record.loggers import get_logger

from marl_sched.errors import MarlSchedError
from marl_sched.train.checkpoint import Counters
from marl_sched.train.collect import Rollout

if TYPE_CHECKING:
    from marl_sched.train.parts import Parts

LoggerName = Literal["csv", "mlflow", "tensorboard", "trackio", "wandb"]


@dataclass(frozen=True)
class Run:
    """A run as callbacks see it.

    Attributes:
        parts: configuration, collector, learner and validation.
        counters: how far it has come; changes with every update.
        directory: where it is written.
    """

    parts: Parts
    counters: Counters
    directory: Path


class Callback:
    """Hooks of the training loop, in the order in which they are called."""

    def on_start(self, run: Run) -> None:
        """Before the first update of this process; `run.counters.update` is not 0 where a run goes on."""

    def on_rollout(self, run: Run, rollout: Rollout) -> None:
        """Turns were collected, nothing was learned from them yet."""

    def on_validation(self, run: Run, score: float) -> None:
        """The policy played the validation instances."""

    def on_update(self, run: Run, values: Mapping[str, float]) -> None:
        """An update is done; `values` is everything that is logged of it, by name."""

    def on_end(self, run: Run) -> None:
        """After the last update of this process, also where an error ended it."""


class LoggerCallback(Callback):
    """Every number of a run to one of TorchRL's loggers: csv, mlflow, tensorboard, trackio or wandb.

    Args:
        name: which; its package must be installed, MarlSchedError says so otherwise.
    """

    def __init__(self, name: LoggerName) -> None:
        self._name = name

    def on_start(self, run: Run) -> None:
        """Open the logger, in the run's folder where it writes files."""
        try:
            self._logger = get_logger(self._name, str(run.directory / "loggers"), run.directory.name or "run")
        except ImportError as error:
            raise MarlSchedError(f"logger={self._name}: expected its package to be installed ({error})") from error

    def on_update(self, run: Run, values: Mapping[str, float]) -> None:
        """Log every number at the update's step."""
        if self._logger is not None:
            for name, value in values.items():
                self._logger.log_scalar(name, float(value), step=int(values["update"]))
