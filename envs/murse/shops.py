"""Job shops and flexible job shops as MuRSE problems; the format is told by the content of the file.

| Format | After the first line, `jobs machines` |
|---|---|
| job shop (JSPLIB) | per job its pairs of machine and duration, one per machine, machines from 0 |
| Taillard's | per job its durations, then per job its machines, from 1; words such as `Times` may stand between |
| flexible (FJSPLIB) | per job its operations, each as number of machines and pairs of machine, from 1, and duration |

Machines are robots, an operation's place in its job is a wait of 0, a machine that cannot do an operation is
ineligible. An operation may take 0. Files that hold more than this (set-up times between operations, assembly of
several jobs) or that count machines otherwise are refused with what they seem to be.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from marl_sched.envs.murse.instance import INELIGIBLE, NO_DEADLINE, MurseInstance
from marl_sched.envs.murse.learning import CURVE
from marl_sched.envs.murse.lines import Line, checked, header, read_lines
from marl_sched.errors import InvalidFileError

Job = list[dict[int, int]]
"""Per operation: machine from 0 -> duration."""


def read_shop(path: str | Path) -> MurseInstance:
    """Read a shop in any of the formats of this module, told by its content. Raises InvalidFileError."""
    path = Path(path)
    lines = _numeric(read_lines(path))
    first = header(path, lines, 2, "jobs machines")
    n_jobs, n_machines = _sizes(first)
    rows = lines[1:]
    if len(rows) == 2 * n_jobs and all(len(row.words) == n_machines for row in rows):
        return _instance(path, _taillard(rows, n_machines), n_machines)
    plain = all(len(row.words) == 2 * n_machines for row in rows[:n_jobs])
    flexible = len(first.words) > 2 or path.suffix == ".fjs" or (not plain and any(map(_fits_flexible, rows[:n_jobs])))
    return read_flexible_job_shop(path) if flexible else read_job_shop(path)


def read_job_shop(path: str | Path) -> MurseInstance:
    """Read a job shop in the format of JSPLIB; machines are numbered from 0. Raises InvalidFileError."""
    path = Path(path)
    lines = read_lines(path)
    n_jobs, n_machines = _sizes(header(path, lines, 2, "jobs machines"))
    _expect_jobs(lines, n_jobs)
    jobs: list[Job] = []
    for line in lines[1:]:
        line.exactly(2 * n_machines, "a machine and a duration per operation")
        values = line.integers("machines and durations")
        job = [{values[k]: values[k + 1]} for k in range(0, len(values), 2)]
        _expect_machines(line, job, 0, n_machines, "a job shop")
        jobs.append(job)
    return _instance(path, jobs, n_machines)


def read_flexible_job_shop(path: str | Path) -> MurseInstance:
    """Read a flexible job shop in the format of FJSPLIB (Brandimarte, 1993); machines are numbered from 1.

    Raises InvalidFileError.
    """
    path = Path(path)
    lines = read_lines(path)
    n_jobs, n_machines = _sizes(header(path, lines, 2, "jobs machines"))
    _expect_jobs(lines, n_jobs)
    jobs: list[Job] = []
    for line in lines[1:]:
        job = _flexible_job(line)
        _expect_machines(line, job, 1, n_machines, "a flexible job shop")
        jobs.append([{machine - 1: duration for machine, duration in each.items()} for each in job])
    return _instance(path, jobs, n_machines)


def _numeric(lines: list[Line]) -> list[Line]:
    """The lines without those that hold words, such as the headings of Taillard's files."""
    return [line for line in lines if line.words[0].lstrip("-").replace(".", "", 1).isdigit()]


def _sizes(line: Line) -> tuple[int, int]:
    n_jobs, n_machines = (int(value) for value in line.numbers("jobs machines")[:2])
    if min(n_jobs, n_machines) < 1:
        raise line.fail("at least one job and one machine", " ".join(line.words))
    return n_jobs, n_machines


def _expect_jobs(lines: list[Line], n_jobs: int) -> None:
    if len(lines) > n_jobs + 1:
        raise lines[n_jobs + 1].fail(
            f"{n_jobs} lines of jobs and nothing more; further tables are a shop with set-up times (SDST) or assembly, "
            "which are not supported",
            f"{len(lines) - 1 - n_jobs} more lines",
        )
    if len(lines) != n_jobs + 1:
        raise lines[-1].fail(f"{n_jobs} lines of jobs", len(lines) - 1)


def _expect_machines(line: Line, job: Job, first: int, n_machines: int, kind: str) -> None:
    """Complain of machines outside the numbers of the format, and say so if they are counted the other way."""
    machines = {machine for each in job for machine in each}
    outside = sorted(machine for machine in machines if not first <= machine < first + n_machines)
    if outside:
        expected = f"machines in {first}..{first + n_machines - 1}"
        if outside in ([0], [n_machines]) and (first if outside == [n_machines] else n_machines) not in machines:
            expected += f" (this seems to be {kind} whose machines are counted from {1 - first})"
        raise line.fail(expected, outside[0])


def _flexible_job(line: Line) -> Job:
    values, at = line.integers("operations with their machines and durations"), 1
    found: Job = []
    for _ in range(values[0]):
        count = values[at] if at < len(values) else 0
        pairs = values[at + 1 : at + 1 + 2 * count]
        if count < 1 or len(pairs) < 2 * count:
            raise line.fail(f"{values[0]} operations with at least one machine each", f"{len(found)}")
        found.append(dict(zip(pairs[::2], pairs[1::2], strict=True)))
        at += 1 + 2 * count
    if at != len(values):
        raise line.fail(f"nothing after {values[0]} operations", line.words[at])
    return found


def _fits_flexible(line: Line) -> bool:
    """Whether a line reads as the operations of a flexible job."""
    try:
        _flexible_job(line)
    except InvalidFileError:
        return False
    return True


def _taillard(rows: list[Line], n_machines: int) -> list[Job]:
    jobs: list[Job] = []
    half = len(rows) // 2
    for times, places in zip(rows[:half], rows[half:], strict=True):
        machines = places.integers("machines")
        job = [{machine: time} for machine, time in zip(machines, times.integers("durations"), strict=True)]
        _expect_machines(places, job, 1, n_machines, "Taillard's format")
        jobs.append([{machine - 1: time for machine, time in each.items()} for each in job])
    return jobs


def _instance(path: Path, jobs: list[Job], n_machines: int) -> MurseInstance:
    """The problem of these jobs."""
    operations = [each for job in jobs for each in job]
    durations = np.full((len(operations), n_machines), INELIGIBLE, np.int64)
    waits: list[tuple[int, int, int]] = []
    number = 0
    for job in jobs:
        for place, machines in enumerate(job):
            durations[number, list(machines)] = list(machines.values())
            if place:
                waits.append((number, number - 1, 0))
            number += 1
    n = len(operations)
    return checked(
        path,
        robot_durations=durations,
        curves=np.zeros((n, 0, len(CURVE))),
        deadlines=np.full(n, NO_DEADLINE),
        waits=np.array(waits, np.int64).reshape(-1, 3),
        locations=np.zeros((n, 2)),
        weights=np.ones(n),
        proximity="none",
        learning="none",
        duration_range=(1, max(1, int(durations.max(initial=1)))),
    )
