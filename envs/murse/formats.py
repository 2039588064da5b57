"""Problem files of others: the published MuRSE text format, job shops (JSPLIB) and flexible job shops (FJSPLIB).

Published MuRSE, one set of files per problem, tasks numbered from 1:

    N.txt        tasks robots humans map_width min_duration max_duration p_deadline p_wait
    N_dur.txt    per task, its duration for each robot, then for each human (humans follow _human instead)
    N_human.txt  per task, for each human: c c_std k k_std beta beta_std
    N_ddl.txt    task deadline; may be empty
    N_wait.txt   i j w: task i starts at least w after task j finishes; may be empty
    N_loc.txt    per task: x y

In job shops machines are robots, an operation's place in its job is a wait of 0, and a machine that cannot do
an operation is ineligible. Every complaint names the file and the line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marl_sched.envs.murse import reading
from marl_sched.envs.murse.instance import NO_DEADLINE, MurseInstance, find_cycle
from marl_sched.envs.murse.learning import CURVE
from marl_sched.errors import InvalidFileError, InvalidOptionError
from marl_sched.files import replacing


@dataclass(frozen=True)
class _Line:
    """One line's words, and where it stands."""

    path: Path
    number: int
    words: tuple[str, ...]

    def fail(self, expected: str, got: object | None = None) -> InvalidFileError:
        """The complaint about this line."""
        return InvalidFileError(self.path, f"line {self.number}", expected, got)

    def numbers(self, what: str) -> list[float]:
        """All words as numbers >= 0; `what` describes the line."""
        values = []
        for word in self.words:
            try:
                value = float(word)
            except ValueError:
                raise self.fail(what, word) from None
            if not np.isfinite(value) or value < 0:
                raise self.fail(f"{what}, none of them negative", word)
            values.append(value)
        return values

    def integers(self, what: str) -> list[int]:
        """All words as integers >= 0; `what` describes the line."""
        values = self.numbers(what)
        for word, value in zip(self.words, values, strict=True):
            if value != int(value):
                raise self.fail(what, word)
        return [int(value) for value in values]

    def exactly(self, count: int, what: str) -> None:
        """Complain unless there are that many words."""
        if len(self.words) != count:
            raise self.fail(f"{count} columns ({what})", len(self.words))


def _read_lines(path: Path) -> list[_Line]:
    """The lines of an ASCII file that hold something, comments (#) left out."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InvalidFileError(path, "", f"a readable file ({error.strerror})") from error
    lines = []
    for number, content in enumerate(raw.splitlines(), start=1):
        if not content.isascii():
            raise InvalidFileError(path, f"line {number}", "ASCII text", content.decode("utf-8", "replace"))
        words = content.decode("ascii").partition("#")[0].split()
        if words:
            lines.append(_Line(path, number, tuple(words)))
    return lines


def _header(path: Path, lines: list[_Line], columns: int, what: str) -> _Line:
    if not lines:
        raise InvalidFileError(path, "line 1", what, "an empty file")
    if len(lines[0].words) < columns:
        raise lines[0].fail(f"at least {columns} columns ({what})", len(lines[0].words))
    return lines[0]


def _per_task(path: Path, n_tasks: int, columns: int, what: str) -> list[_Line]:
    lines = _read_lines(path)
    if len(lines) != n_tasks:
        last = lines[-1].number if lines else 1
        raise InvalidFileError(path, f"line {last}", f"{n_tasks} lines, one per task", len(lines))
    for line in lines:
        line.exactly(columns, what)
    return lines


def read_published(
    path: str | Path,
    *,
    proximity: str = "none",
    learning: str = "none",
    durations: str = "deterministic",
    n_rounds: int = 1,
) -> MurseInstance:
    """Read the set of published files to which `path` (N.txt) belongs.

    The settings default to those under which the published sets were run. Raises InvalidFileError.
    """
    path = Path(path)
    what = "tasks robots humans map_width min_duration max_duration p_deadline p_wait"
    header = _header(path, _read_lines(path), 8, what)
    n, n_robots, n_humans, _, low, high = (int(v) for v in header.numbers(what)[:6])
    width = header.numbers(what)[3]
    if min(n, n_robots + n_humans, low) < 1 or high < low or width <= 0:
        raise header.fail("at least one task and agent, and 1 <= min_duration <= max_duration", " ".join(header.words))
    team = _per_task(_sibling(path, "dur"), n, n_robots + n_humans, "durations of robots, then humans")
    humans = (
        _per_task(_sibling(path, "human"), n, 6 * n_humans, "for each human " + " ".join(CURVE)) if n_humans else []
    )
    places = _per_task(_sibling(path, "loc"), n, 2, "x y")
    deadlines = np.full(n, NO_DEADLINE)
    for line in _read_lines(_sibling(path, "ddl")):
        line.exactly(2, "task deadline")
        task, deadline = line.integers("a task and its deadline")
        index = _task(line, task, n)
        deadlines[index] = deadline if deadlines[index] == NO_DEADLINE else min(deadline, deadlines[index])
    curves = np.array([line.numbers("curves") for line in humans]).reshape(n, n_humans, len(CURVE))
    return _checked(
        path,
        robot_durations=np.array([line.integers("whole durations")[:n_robots] for line in team]).reshape(n, n_robots),
        curves=curves,
        deadlines=deadlines,
        waits=_waits(_sibling(path, "wait"), n),
        locations=np.array([line.numbers("x y") for line in places]),
        weights=np.ones(n),
        proximity=proximity,
        learning=learning,
        durations=durations,
        duration_range=(low, high),
        n_rounds=n_rounds,
        map_width=width,
    )


def _sibling(path: Path, part: str) -> Path:
    return path.with_name(f"{path.stem}_{part}.txt")


def _task(line: _Line, task: int, n_tasks: int) -> int:
    if not 1 <= task <= n_tasks:
        raise line.fail(f"a task in 1..{n_tasks}", task)
    return task - 1


def _waits(path: Path, n_tasks: int) -> np.ndarray:
    rows: list[tuple[int, int, int]] = []
    for line in _read_lines(path):
        line.exactly(3, "i j w: task i starts at least w after task j finishes")
        i, j, w = line.integers("a task, the task that it waits for, and a time")
        rows.append((_task(line, i, n_tasks), _task(line, j, n_tasks), w))
        cycle = find_cycle(n_tasks, np.array(rows))
        if cycle:
            raise line.fail("waits without a cycle", " -> ".join(str(task + 1) for task in cycle))
    return np.array(rows, np.int64).reshape(-1, 3)


def _checked(path: Path, **values: object) -> MurseInstance:
    try:
        return MurseInstance(**values)  # type: ignore[arg-type]  # the callers' values, checked by the class itself
    except InvalidOptionError as error:
        raise InvalidFileError(path, "", f"a possible problem ({error})") from error


def write_published(instance: MurseInstance, path: str | Path) -> None:
    """Write the published set of files to which `path` (N.txt) belongs; settings and task weights are left out."""
    path, n = Path(path), instance.n_tasks
    constrained = [(i + 1, d) for i, d in enumerate(instance.deadlines) if d != NO_DEADLINE]
    shares = [len(constrained) / n, len(set(instance.waits[:, 0])) / n]
    counts = [n, instance.n_robots, instance.n_humans, instance.map_width, *instance.duration_range]
    tables = {
        "dur": instance.mean_durations,
        "human": instance.curves.reshape(n, -1),
        "ddl": constrained,
        "wait": instance.waits + np.array([1, 1, 0]),
        "loc": instance.locations,
    }
    for part, rows in tables.items():
        _write_table(_sibling(path, part), rows)
    _write_table(path, [counts + shares])


def _write_table(path: Path, rows: object) -> None:
    with replacing(path) as temporary:
        temporary.write_text("".join(" ".join(_word(value) for value in row) + "\n" for row in rows), encoding="ascii")  # type: ignore[attr-defined]  # arrays and lists of rows


def _word(value: float) -> str:
    return str(int(value)) if value == int(value) else repr(float(value))


def read_job_shop(path: str | Path) -> MurseInstance:
    """Read a job shop in the format of JSPLIB: jobs and machines, then per job its pairs of machine and duration.

    Machines are numbered from 0. Raises InvalidFileError.
    """

    def operations(line: _Line, n_machines: int) -> list[dict[int, int]]:
        line.exactly(2 * n_machines, "a machine and a duration per operation")
        values = line.integers("machines and durations")
        return [{values[k]: values[k + 1]} for k in range(0, len(values), 2)]

    return _read_shop(Path(path), operations, first_machine=0)


def read_flexible_job_shop(path: str | Path) -> MurseInstance:
    """Read a flexible job shop in the format of FJSPLIB (Brandimarte, 1993).

    Jobs and machines, then per job its number of operations and, for each, the number of eligible machines and
    their pairs of machine and duration. Machines are numbered from 1. Raises InvalidFileError.
    """

    def operations(line: _Line, n_machines: int) -> list[dict[int, int]]:
        values, at = line.integers("operations with their machines and durations"), 1
        found: list[dict[int, int]] = []
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

    return _read_shop(Path(path), operations, first_machine=1)


def _read_shop(
    path: Path, operations: Callable[[_Line, int], list[dict[int, int]]], first_machine: int
) -> MurseInstance:
    lines = _read_lines(path)
    header = _header(path, lines, 2, "jobs machines")
    n_jobs, n_machines = (int(v) for v in header.numbers("jobs machines")[:2])
    if len(lines) != n_jobs + 1:
        raise lines[-1].fail(f"{n_jobs} lines of jobs", len(lines) - 1)
    durations: list[list[int]] = []
    waits: list[tuple[int, int, int]] = []
    for line in lines[1:]:
        for place, machines in enumerate(operations(line, n_machines)):
            row = [0] * n_machines
            for machine, duration in machines.items():
                if not first_machine <= machine < first_machine + n_machines:
                    raise line.fail(f"machines in {first_machine}..{first_machine + n_machines - 1}", machine)
                if duration < 1:
                    raise line.fail("durations >= 1", duration)
                row[machine - first_machine] = duration
            if place:
                waits.append((len(durations), len(durations) - 1, 0))
            durations.append(row)
    n = len(durations)
    return _checked(
        path,
        robot_durations=np.array(durations).reshape(n, n_machines),
        curves=np.zeros((n, 0, len(CURVE))),
        deadlines=np.full(n, NO_DEADLINE),
        waits=np.array(waits),
        locations=np.zeros((n, 2)),
        weights=np.ones(n),
        proximity="none",
        learning="none",
        duration_range=(1, max(map(max, durations), default=1)),
    )


def load(path: str | Path) -> MurseInstance:
    """Read an instance in any known format: .json ours, .fjs FJSPLIB, beside a _dur.txt published, else JSPLIB."""
    path = Path(path)
    if path.suffix == ".json":
        return reading.load(path)
    if path.suffix == ".fjs":
        return read_flexible_job_shop(path)
    return read_published(path) if _sibling(path, "dur").exists() else read_job_shop(path)
