"""The picture of what deciding alone costs, from the figures of `results`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.special import stdtrit

from marl_sched.train.evaluation.plots import shares_against_scores


def price_of_decentralisation(results: Mapping[str, Any]) -> Figure:
    """M1 against the share of the graph that an agent sees, a panel per scale; views with staleness as open points."""
    section = results["decentralisation"]
    stale = {name: view.get("staleness", 0) > 0 for name, view in section["views"].items()}
    panels = {}
    for scale, found in section["scales"].items():
        lines = {
            line["label"]: [
                (point["visible_share"], point["M1"]["mean"], stale[name], _half(point["M1"], results["instances"]))
                for name, point in line["points"].items()
            ]
            for line in found["lines"]
            if line["points"]
        }
        panels[
            f"{results['env']}, {results['instances']} {scale} instances x {section['episodes']} episode"
            + ("s" if section["episodes"] > 1 else "")
        ] = {
            "bound": found["bound"],
            "central": (found["central"]["label"], found["central"]["M1"]),
            "lines": lines,
        }
    return shares_against_scores(panels, measure=f"M1 ({section['objective']})")


def _half(score: Mapping[str, Any], n: int) -> float:
    """Half of the 95 percent interval of a mean over n such instances (Student); 0 for one instance."""
    return float(stdtrit(n - 1, 0.975) * score["std"] / np.sqrt(n)) if n > 1 else 0.0
