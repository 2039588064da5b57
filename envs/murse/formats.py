"""Problem files of others, told apart by their content: published MuRSE text, job shops, flexible job shops, our JSON.

Published MuRSE, one set of files per problem, tasks numbered from 1:

    N.txt        tasks robots humans map_width min_duration max_duration p_deadline p_wait
    N_dur.txt    per task, its duration for each robot (0: ineligible), then for each human (who follow _human instead)
    N_human.txt  per task, for each human: c c_std k k_std beta beta_std
    N_ddl.txt    task deadline; may be empty
    N_wait.txt   i j w: task i starts at least w after task j finishes; may be empty
    N_loc.txt    per task: x y

Shops are described in `marl_sched.envs.murse.shops`. Every complaint names the file and the line.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from marl_sched.envs.murse import reading
from marl_sched.envs.murse.instance import INELIGIBLE, NO_DEADLINE, MurseInstance, find_cycle
from marl_sched.envs.murse.learning import CURVE
from marl_sched.envs.murse.lines import Line, checked, header, read_lines
from marl_sched.envs.murse.shops import read_flexible_job_shop, read_job_shop, read_shop
from marl_sched.errors import InvalidFileError
from marl_sched.files import replacing

__all__ = ["instance_files", "load", "read_flexible_job_shop", "read_job_shop", "read_published", "write_published"]
PARTS = ("dur", "human", "ddl", "wait", "loc")


def _per_task(path: Path, n_tasks: int, columns: int, what: str) -> list[Line]:
    lines = read_lines(path)
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
    first = header(path, read_lines(path), 8, what)
    n, n_robots, n_humans, _, low, high = (int(v) for v in first.numbers(what)[:6])
    width = first.numbers(what)[3]
    if min(n, n_robots + n_humans, low) < 1 or high < low or width <= 0:
        raise first.fail("at least one task and agent, and 1 <= min_duration <= max_duration", " ".join(first.words))
    team = _per_task(_sibling(path, "dur"), n, n_robots + n_humans, "durations of robots, then humans")
    humans = (
        _per_task(_sibling(path, "human"), n, 6 * n_humans, "for each human " + " ".join(CURVE)) if n_humans else []
    )
    places = _per_task(_sibling(path, "loc"), n, 2, "x y")
    deadlines = np.full(n, NO_DEADLINE)
    for line in read_lines(_sibling(path, "ddl")):
        line.exactly(2, "task deadline")
        task, deadline = line.integers("a task and its deadline")
        index = _task(line, task, n)
        deadlines[index] = deadline if deadlines[index] == NO_DEADLINE else min(deadline, deadlines[index])
    robots = np.array([line.integers("whole durations")[:n_robots] for line in team], np.int64).reshape(n, n_robots)
    curves = np.array([line.numbers("curves") for line in humans]).reshape(n, n_humans, len(CURVE))
    return checked(
        path,
        robot_durations=np.where(robots > 0, robots, INELIGIBLE),
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


def _task(line: Line, task: int, n_tasks: int) -> int:
    if not 1 <= task <= n_tasks:
        raise line.fail(f"a task in 1..{n_tasks}", task)
    return task - 1


def _waits(path: Path, n_tasks: int) -> np.ndarray:
    rows: list[tuple[int, int, int]] = []
    lines = read_lines(path)
    for line in lines:
        line.exactly(3, "i j w: task i starts at least w after task j finishes")
        i, j, w = line.integers("a task, the task that it waits for, and a time")
        rows.append((_task(line, i, n_tasks), _task(line, j, n_tasks), w))
    waits = np.array(rows, np.int64).reshape(-1, 3)
    if find_cycle(n_tasks, waits):
        for count, line in enumerate(lines, start=1):  # which line closes it
            cycle = find_cycle(n_tasks, waits[:count])
            if cycle:
                raise line.fail("waits without a cycle", " -> ".join(str(task + 1) for task in cycle))
    return waits


def write_published(instance: MurseInstance, path: str | Path) -> None:
    """Write the published set of files to which `path` (N.txt) belongs; settings and task weights are left out."""
    path, n = Path(path), instance.n_tasks
    constrained = [(i + 1, d) for i, d in enumerate(instance.deadlines) if d != NO_DEADLINE]
    shares = [len(constrained) / n, len(set(instance.waits[:, 0])) / n]
    counts = [n, instance.n_robots, instance.n_humans, instance.map_width, *instance.duration_range]
    tables = {
        "dur": np.maximum(instance.mean_durations, 0),
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


def load(path: str | Path) -> MurseInstance:
    """Read an instance in any known format, told by its content.

    A file that begins with a brace is our JSON, one beside a file N_dur.txt the head of a published set, everything
    else a shop, see `read_shop`. Raises InvalidFileError.
    """
    path = Path(path)
    if _sibling(path, "dur").exists():
        return read_published(path)
    try:
        with path.open("rb") as file:
            begins = file.read(64).lstrip()
    except OSError as error:
        raise InvalidFileError(path, "", f"a readable file ({error.strerror})") from error
    return reading.load(path) if begins.startswith(b"{") or path.suffix == ".json" else read_shop(path)


def instance_files(folder: Path) -> list[Path]:
    """The files of a folder that should hold an instance each, sorted: all but hidden ones, texts and parts of sets."""
    parts = tuple(f"_{part}" for part in PARTS)
    return sorted(
        path
        for path in folder.iterdir()
        if path.is_file()
        and not path.name.startswith(".")
        and path.suffix.lower() not in (".md", ".rst", ".py", ".csv", ".png")
        and path.stem.upper() not in ("README", "LICENSE", "LICENCE")
        and not (path.suffix == ".txt" and path.stem.endswith(parts))
    )
