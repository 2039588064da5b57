"""How schedulers do in each round of an episode, from cells: learning curves as a table (figures 5.6 and 5.7)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from marl_sched.train.published.comparisons import Cell

MOST_ROUNDS = 5  # that are shown, spread over the episode


def shown_rounds(count: int) -> list[int]:
    """Which of `count` rounds a table shows, counted from 0: the first, the last, and some between them."""
    return sorted({round(place) for place in np.linspace(0, count - 1, min(count, MOST_ROUNDS))})


def by_round(cells: Mapping[str, Cell]) -> tuple[list[str], list[list[str]]]:
    """Head and lines: for every label, percentage feasible and mean objective of some rounds over all instances.

    Instances with fewer rounds do not count in later ones.
    """
    count = max(len(rounds) for cell in cells.values() for rounds in cell.objective)
    shown = shown_rounds(count)
    heads = ["scheduler", *(f"round {number + 1}" for number in shown)]
    return heads, [[label, *(_figures(cell, number) for number in shown)] for label, cell in cells.items()]


def _figures(cell: Cell, number: int) -> str:
    there = [i for i, rounds in enumerate(cell.objective) if len(rounds) > number]
    feasible = 100 * np.mean([cell.feasible[i][number] for i in there])
    return f"{feasible:.0f} % {np.mean([cell.objective[i][number] for i in there]):.0f}"
