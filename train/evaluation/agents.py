"""Figures of single agents, summarised over episodes: who works how much, and how fairly work is shared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from marl_sched.train.evaluation.results import AgentFigure, AgentsSummary

SHARED = "utilisation"  # the figure by which work is said to be shared


def fairness(values: np.ndarray) -> np.ndarray:
    """Jain's index (sum x)^2 / (n sum x^2) along the last axis of float64 (..., A), NaN where there is no agent.

    1: all alike; 1 / n: one has everything. 1 where nobody has anything. (Jain, Chiu and Hawe 1984.)
    """
    there = ~np.isnan(values)
    x = np.where(there, values, 0.0)
    squares = there.sum(axis=-1) * (x**2).sum(axis=-1)
    return np.where(squares > 0, x.sum(axis=-1) ** 2 / np.where(squares > 0, squares, 1.0), 1.0)


def joined_figures(parts: Sequence[dict[str, np.ndarray]], n_instances: int) -> dict[str, np.ndarray]:
    """Figures of consecutive rows, name -> (rows, A), with any padding, as one of shape (I, E, A)."""
    if not parts[0]:
        return {}
    widest = max(next(iter(part.values())).shape[1] for part in parts)

    def padded(values: np.ndarray) -> np.ndarray:
        return np.pad(values, ((0, 0), (0, widest - values.shape[1])), constant_values=np.nan)

    whole = {name: np.concatenate([padded(part[name]) for part in parts]) for name in parts[0]}
    return {name: values.reshape(n_instances, -1, widest) for name, values in whole.items()}


def summarise_agents(figures: Mapping[str, np.ndarray], names: Sequence[str] | None = None) -> AgentsSummary:
    """Figures, name -> float64 (I, E, A), summarised.

    Of each figure the mean over all agents of all episodes, and the means over episodes of the least and the greatest
    agent; `fairness` of the utilisation. With `names`, one for each agent of the only instance, also `by_agent`.
    """
    found = {
        name: AgentFigure(
            mean=float(np.nanmean(values)),
            least=float(np.nanmin(values, axis=-1).mean()),
            greatest=float(np.nanmax(values, axis=-1).mean()),
        )
        for name, values in figures.items()
    }
    if SHARED in figures:
        found["fairness"] = AgentFigure(mean=float(fairness(figures[SHARED]).mean()))
    by_agent = None
    if names is not None:
        means = {name: values.mean(axis=(0, 1)) for name, values in figures.items()}
        by_agent = {agent: {name: float(mean[i]) for name, mean in means.items()} for i, agent in enumerate(names)}
    return AgentsSummary(figures=found, by_agent=by_agent)
