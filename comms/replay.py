"""A run played again from its log, to the last bit: its report, and its picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from marl_sched.comms.decision_log import SCHEMA, Header, Step, play_again, played, read_log
from marl_sched.comms.metrics.report import RunReport, build_report
from marl_sched.comms.metrics.run_metrics import RunMetrics
from marl_sched.comms.options import Conflict, WorldOptions
from marl_sched.comms.protocol.events import End, Ending
from marl_sched.errors import InvalidFileError, InvalidOptionError
from marl_sched.problem import Problem

PICTURE = "rgb_array"


def replay(path: Path, picture: Path | None = None) -> RunReport:
    """The report of a logged run as far as its log goes; what only the living run knew is zero or None in it.

    `picture` gets the domain's picture of it as PNG. Raises InvalidFileError for a file that is no log, that another
    version wrote, whose instance has changed, or whose commits come out otherwise here; InvalidOptionError for a
    picture of a domain that draws none.
    """
    lines = read_log(path)
    if not lines or not isinstance(lines[0], Header):
        raise InvalidFileError(path, "line 1", "what is played", None)
    header = lines[0]
    if header.schema != SCHEMA:
        raise InvalidFileError(path, "schema", f"{SCHEMA}, the version that this package reads", header.schema)
    options = _options(path, header)
    domain = options.domain
    if picture is not None and PICTURE not in domain.render:
        raise InvalidOptionError(f"picture: {domain.name} draws none")
    extra = domain.render_options.get(PICTURE, {}) if picture is not None else {}
    if header.plant:
        raise InvalidFileError(path, "plant", "the simulated one, which can be played again", header.plant)
    plant = options.simulated_plant(**extra)
    steps = [line for line in lines if isinstance(line, Step)]
    play_again(plant, played(lines), path)
    if picture is not None:
        _draw(picture, domain.render[PICTURE](plant.simulator, 0))
    over = bool(plant.simulator.over[0])
    summary = plant.summary()
    reason = "" if over else f"the log ends at {options.telemetry().time_unit} {summary.time}"
    return build_report(
        options,
        ending=End(Ending.COMPLETE if over else Ending.FAILED, reason),
        summary=summary,
        commits=[commit for step in steps for commit in step.commits],
        slots=[],
        metrics=RunMetrics(),
        seconds=0.0,
        from_log=str(path),
    )


def _options(path: Path, header: Header) -> WorldOptions:
    """The options that the header states; the instance must be the one that was played."""
    try:
        conflict = msgspec.convert(header.conflict, Conflict)
    except msgspec.ValidationError as error:
        raise InvalidFileError(path, "conflict", f"a way to settle conflicts ({error})", header.conflict) from error
    try:
        problem = Problem.from_json(header.problem, f"{path}: problem")
        options = WorldOptions(problem=problem, run=header.run, conflict=conflict)
    except (InvalidOptionError, TypeError) as error:
        raise InvalidFileError(path, "problem", f"what a world can play ({error})", header.problem) from error
    identity = Header.of(options).identity
    if identity != header.identity:
        expected = f"the instance that was played, {header.identity}"
        raise InvalidFileError(path, "problem.instances", expected, identity)
    return options


def _draw(path: Path, pixels: Any) -> None:
    from matplotlib.image import imsave

    imsave(path, pixels)
