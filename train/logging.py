"""What a run tells while it goes on: a progress bar with the current M1, `progress.csv`, and TensorBoard events."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch.utils.tensorboard import SummaryWriter

from marl_sched.files import replacing

COLUMNS = (
    "update", "seconds", "hours", "decisions", "reward_rate", "validation", "best", "policy_loss", "regret",
    "value_loss", "explained_variance", "entropy", "kl", "clipped", "gradient", "length",
)  # fmt: skip


class RunLog:
    """A context in which updates are logged.

    Args:
        directory: of the run; holds `progress.csv` and `tensorboard/`.
        updates: of the whole run.
        start: updates done already; rows of later ones, left by a run that was stopped, are dropped.
        device: where the run's networks learn, in words, told once.
        quiet: show no progress bar, tell nothing.
    """

    def __init__(self, directory: Path, *, updates: int, start: int, device: str, quiet: bool = False) -> None:
        self._path, self._start, self._device = directory / "progress.csv", start, device
        self._writer = SummaryWriter(str(directory / "tensorboard"), purge_step=start + 1)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True, quiet=quiet),
        )
        self._task = self._bar.add_task("training", total=updates, completed=start)
        self._best, self._validation = float("nan"), float("nan")

    def __enter__(self) -> RunLog:
        """Open the table and show the bar."""
        rows = read_progress(self._path) if self._start > 0 else []
        with replacing(self._path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(row for row in rows if int(row["update"]) <= self._start)
        self._file = self._path.open("a", newline="", encoding="utf-8")
        self._table = csv.DictWriter(self._file, COLUMNS)
        self._bar.console.print(f"training on {self._device}", highlight=False)
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close everything."""
        self._bar.stop()
        self._file.close()
        self._writer.close()

    def update(self, values: Mapping[str, float]) -> None:
        """One row; keys are among COLUMNS, `update` is the number of updates done."""
        done = int(values["update"])
        self._table.writerow({name: _short(value) for name, value in values.items()})
        self._file.flush()
        for name, value in values.items():
            if name != "update":
                self._writer.add_scalar(name, value, done)
        self._validation = values.get("validation", self._validation)
        self._best = values.get("best", self._best)
        text = f"M1 sampled {values['reward_rate']:.3f}, validated {self._validation:.4f}, best {self._best:.4f}"
        self._bar.update(self._task, completed=done, description=text)


def read_progress(path: Path) -> list[dict[str, str]]:
    """The rows of a `progress.csv`."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _short(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.6g}"
