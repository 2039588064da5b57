"""What single agents did, as a table."""

from __future__ import annotations

import sys

from tabulate import tabulate

from marl_sched.cli.tables import print_rows
from marl_sched.errors import InvalidOptionError
from marl_sched.train.evaluation.results import AgentFigure, Results

_KINDS = {"markdown": "github", "latex": "latex_booktabs"}


def print_agents(results: Results, style: str = "table", *, stderr: bool = False) -> None:
    """A row per scheduler with the mean of every figure and, in brackets, its least and its greatest agent.

    With one instance a row per agent follows. Nothing is printed for the styles csv and json, whose only table holds
    the scores. Raises InvalidOptionError where the environment counts nothing of single agents.
    """
    rows = {name: row.agents for name, row in results.schedulers.items() if row.agents is not None}
    if not rows:
        env = results.problem.domain.name
        raise InvalidOptionError(f"--agents: the environment {env!r} counts nothing of single agents")
    if style in ("csv", "json"):
        return
    figures = list(next(iter(rows.values())).figures)
    table = [[name, *(_cell(row.figures[figure]) for figure in figures)] for name, row in rows.items()]
    _print(["scheduler", *figures], table, style, stderr, "agents: mean, and means of the least and the greatest one")
    single = [
        [name, agent, *(_number(values.get(figure)) for figure in figures if figure != "fairness")]
        for name, row in rows.items()
        for agent, values in (row.by_agent or {}).items()
    ]
    if single:
        _print(["scheduler", "agent", *(f for f in figures if f != "fairness")], single, style, stderr, "")


def _print(headings: list[str], rows: list[list[str]], style: str, stderr: bool, title: str) -> None:
    if style in _KINDS:
        out = sys.stderr if stderr else sys.stdout
        out.write("\n" + tabulate(rows, headers=headings, tablefmt=_KINDS[style], disable_numparse=True) + "\n")
        return
    print_rows(headings, rows, title=title, stderr=stderr)


def _cell(figure: AgentFigure) -> str:
    spread = "" if figure.least is None else f" [{_number(figure.least)}, {_number(figure.greatest)}]"
    return f"{_number(figure.mean)}{spread}"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}" if abs(value) < 10 else f"{value:.1f}"
