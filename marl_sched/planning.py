"""What a domain declares for planners: advice, schedules, and what is fitted from records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Measure:
    """Something that is measured in every unit of time: float64 (B, T), and how units are joined to a longer step."""

    values: np.ndarray
    joined: Literal["mean", "sum"]
    better: Literal["higher", "lower"]


class Advice(Protocol):
    """What `marl-sched advise` tells of a domain.

    Attributes:
        step: what the time to come is told in, and how many of the domain's `unit` that is, such as ("day", 24).
        steps: how many are told unless somebody asks for another number.
        appraiser: the scheduler whose worths stand in for those of one that tells none.
    """

    step: tuple[str, int]
    steps: int
    appraiser: str

    def choices(self, simulator: Any, env_index: int) -> list[tuple[str, dict[str, Any]]]:
        """What every action of the acting agent is called, and what is known of it, in the order of actions."""

    def outlook(self, simulator: Any) -> Mapping[str, Measure]:
        """What happened in every unit of time so far, in all rows; the first measure is what futures are ranked by."""

    def figure(self, episodes: Mapping[str, Any], until: int, env_index: int) -> Figure:
        """One row of several simulators as a picture, caption -> simulator; needs matplotlib."""


class Schedules(Protocol):
    """The schedules of a domain whose episodes have rounds, each as plain data that is written as JSON."""

    def of(self, simulator: Any, env_index: int, round_index: int) -> dict[str, Any]:
        """The schedule of an ended round of a row."""

    def decode(self, data: Any, where: str | Path) -> dict[str, Any]:
        """The schedule in a file's data; InvalidFileError names `where` and the field."""

    def problems(self, data: Mapping[str, Any]) -> list[str]:
        """What an independent check finds wrong, a sentence each; empty if the schedule is confirmed and feasible."""

    def explain(self, data: Mapping[str, Any]) -> list[str]:
        """Why a schedule is infeasible, a sentence each; empty if it is feasible."""

    def summary(self, data: Mapping[str, Any]) -> dict[str, Any]:
        """What a table says of a schedule: name -> value."""

    def rows(self, data: Mapping[str, Any]) -> tuple[list[str], list[list[Any]]]:
        """Headings and rows of a spreadsheet of the schedule."""

    def figure(self, schedules: Mapping[str, Mapping[str, Any]]) -> Figure:
        """Charts of schedules by their captions, on one axis of time; needs matplotlib."""


class Fitted(Protocol):
    """What was estimated from records."""

    def as_json(self) -> dict[str, Any]:
        """Plain data of a file that the domain's own `import` reads."""

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Headings and rows, for people."""

    @property
    def remark(self) -> str:
        """What the numbers mean where they go, a sentence or two."""

    def figure(self) -> Figure:
        """A picture of records and estimates; needs matplotlib."""
