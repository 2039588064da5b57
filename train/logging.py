"""What a run tells while it goes on: a progress bar with the current M1, and `progress.csv`."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from marl_sched.files import replacing
from marl_sched.train.callbacks import Callback, Run
from marl_sched.train.device import described, device_of


class RunLog(Callback):
    """The run's own log: `progress.csv`, whose columns are what was logged.

    Rows of updates that a run did after its last checkpoint are dropped when it goes on.

    Args:
        quiet: show no progress bar, tell nothing.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True, quiet=quiet),
        )
        self._best, self._validation = float("nan"), float("nan")

    def on_start(self, run: Run) -> None:
        """Open the table and show the bar."""
        self._path, start = run.directory / "progress.csv", run.counters.update
        rows = read_progress(self._path) if start > 0 else []
        self._rows: list[Mapping[str, str]] = [row for row in rows if int(row["update"]) <= start]
        self._columns = list(rows[0]) if rows else []
        self._write_all()
        device = described(device_of(run.parts.learner.policy))
        self._task = self._bar.add_task("training", total=run.parts.record.config.updates, completed=start)
        self._bar.console.print(f"training on {device}, turns collected by {run.parts.collector.name}", highlight=False)
        self._bar.start()

    def on_end(self, run: Run) -> None:
        """Take the bar away."""
        self._bar.stop()

    def on_update(self, run: Run, values: Mapping[str, float]) -> None:
        """One row; `values["update"]` is the number of updates done."""
        done = int(values["update"])
        self._rows.append({name: _short(value) for name, value in values.items()})
        new = [name for name in values if name not in self._columns]
        if new:
            self._columns += new
            self._write_all()
        else:
            with self._path.open("a", newline="", encoding="utf-8") as file:
                csv.DictWriter(file, self._columns).writerow(self._rows[-1])
        self._validation = values.get("validation", self._validation)
        self._best = values.get("best", self._best)
        text = f"M1 sampled {values['reward_rate']:.3f}, validated {self._validation:.4f}, best {self._best:.4f}"
        self._bar.update(self._task, completed=done, description=text)

    def _write_all(self) -> None:
        """The whole table, with the columns that are known by now."""
        with replacing(self._path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self._columns)
            writer.writeheader()
            writer.writerows(self._rows)


def read_progress(path: Path) -> list[dict[str, str]]:
    """The rows of a `progress.csv`."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _short(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.6g}"
