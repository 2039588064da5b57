"""Hooks of a training run: what users of Python hang into the loop without changing it.

    class Print(Callback):
        def on_update(self, run: Run, values: Mapping[str, float]) -> None:
            print(values["update"], values["reward_rate"])

    train(load_config(["view=local"]), callbacks=[Print()])

Every hook does nothing unless a subclass says otherwise. The run's own log (marl_sched.train.logging) is a callback,
and so is `LoggerCallback`, which hands every number to one of TorchRL's loggers (`logger=wandb`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from torchrl.record.loggers import get_logger

from marl_sched.errors import MarlSchedError
from marl_sched.train.checkpoint import Counters
from marl_sched.train.collect import Experience

if TYPE_CHECKING:
    from marl_sched.train.parts import Parts

PROJECT = "marl-sched"  # in trackio
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

    def on_rollout(self, run: Run, rollout: Experience) -> None:
        """Turns, or other experience, were collected, nothing was learned from them yet."""

    def on_validation(self, run: Run, score: float) -> None:
        """The policy played the validation instances."""

    def on_update(self, run: Run, values: Mapping[str, float]) -> None:
        """An update is done; `values` is everything that is logged of it, by name."""

    def on_end(self, run: Run) -> None:
        """After the last update of this process, also where an error ended it."""


class LoggerCallback(Callback):
    """Every number of a run to one of TorchRL's loggers, by its word in the configuration.

    `tensorboard` and `csv` write into folders of these names in the run's folder. `mlflow` writes to where
    MLFLOW_TRACKING_URI says, else to `mlflow/mlflow.db` there. `wandb` and `trackio` go by their own settings; the run
    has its folder's name.

    Args:
        name: which. Raises MarlSchedError, with the extra that brings it, where its package is not installed.
    """

    def __init__(self, name: LoggerName) -> None:
        if name != "csv" and find_spec(name) is None:
            extra = "train" if name == "tensorboard" else name
            raise MarlSchedError(f"logger={name}: {name} is not installed: pip install 'marl-sched[{extra}]'")
        self._name = name
        self._logger: Any = None

    def on_start(self, run: Run) -> None:
        """Open the logger; where TensorBoard goes on, points after the last checkpoint are dropped."""
        self._logger = _open(self._name, run.directory)
        if self._name == "tensorboard" and run.counters.update:
            self._drop_later(run.counters.update + 1)

    def _drop_later(self, step: int) -> None:
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog  # type: ignore[import-untyped]

        writer = self._logger.experiment.file_writer
        writer.add_event(Event(step=step, file_version="brain.Event:2"))
        writer.add_event(Event(step=step, session_log=SessionLog(status=SessionLog.START)))

    def on_update(self, run: Run, values: Mapping[str, float]) -> None:
        """Log every number at the update's step."""
        for name, value in values.items():
            if name != "update":
                self._logger.log_scalar(name, float(value), step=int(values["update"]))

    def on_end(self, run: Run) -> None:
        """Close what has to be closed, so that every number is kept."""
        experiment = getattr(self._logger, "experiment", None)
        for close in ("close", "finish"):  # TensorBoard's and W&B's words
            if hasattr(experiment, close):
                getattr(experiment, close)()
                return


def _open(name: LoggerName, directory: Path) -> Any:
    """TorchRL's logger of that name for a run in a folder."""
    run, own = directory.absolute().name, directory / name
    if name in ("csv", "tensorboard"):
        return get_logger(name, str(directory), name)
    if name != "mlflow":
        return get_logger(name, str(own), run, trackio_kwargs={"project": PROJECT})
    from torchrl.record.loggers.mlflow import MLFlowLogger

    own.mkdir(exist_ok=True)  # get_logger knows no other store than files, which MLflow 3 refuses
    where = os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{own.absolute()}/mlflow.db"
    return MLFlowLogger(exp_name=run, tracking_uri=where, artifact_location=own.absolute().as_uri())
