"""The run's log: one JSON line for the problem, then one for every commit and every order; appended, never changed.

A world that is restarted with the log of its run plays the commits again, holds their outcomes and rewards against
what was written down, lets the orders hold that it had accepted, and goes on from there. `marl-sched replay` does the
same and stops at the end. A last line that was cut off is not a commit: nobody was told of it before it stood in the
log.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal, Protocol

import msgspec

from marl_sched.comms.plant import Commit, Plant
from marl_sched.comms.protocol.events import Choice, Outcome
from marl_sched.comms.protocol.messages import Operator, Team, Work
from marl_sched.errors import InvalidFileError

if TYPE_CHECKING:
    from marl_sched.comms.options import WorldOptions

SCHEMA = 1
Sync = Literal["never", "commit"]
_FORCED = (Outcome.LATE, Outcome.ABSENT)


class Header(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="run"):
    """The first line: what is played.

    Attributes:
        problem: as `Problem.as_json` gives it.
        identity: of its instance, in hexadecimal digits: a file may change, and a generator.
        conflict: how choices of one action are settled, see WorldOptions.
        plant: what made the plant, "" for the simulated one.
    """

    schema: int
    run: str
    problem: dict[str, Any]
    identity: str
    conflict: str
    plant: str = ""

    @classmethod
    def of(cls, options: WorldOptions) -> Header:
        """The header of a run with these options."""
        problem = options.problem
        return cls(
            schema=SCHEMA,
            run=options.run,
            problem=problem.as_json(),
            identity=f"{int(problem.instances[0].identity):016x}",
            conflict=options.conflict,
            plant=options.plant_factory,
        )


class Resumed(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="resumed"):
    """Another epoch of the world goes on from here."""

    epoch: str


class Step(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="commit"):
    """What was applied at once, and what became of it.

    `sources` says for each commit which decision was applied, as `incarnation/sequence`; "" where there was none.
    """

    commits: list[Commit]
    sources: list[str] = []


class Accepted(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="order"):
    """An operator's order that holds from here on."""

    order: Team | Work | Operator


Line = Header | Resumed | Step | Accepted
_encoder, _decoder = msgspec.json.Encoder(), msgspec.json.Decoder(Line)


class CommitLog(Protocol):
    """Where commits are kept."""

    def append(self, line: Resumed | Step | Accepted) -> None:
        """Keep a line before anybody is told of it."""

    def commits(self) -> Iterator[Commit]:
        """All commits so far, in order."""


@dataclass
class MemoryLog:
    """Commits of a run that nobody continues."""

    lines: list[Resumed | Step | Accepted] = field(default_factory=list)

    def append(self, line: Resumed | Step | Accepted) -> None:
        """See CommitLog.append."""
        self.lines.append(line)

    def commits(self) -> Iterator[Commit]:
        """See CommitLog.commits."""
        return (commit for line in self.lines if isinstance(line, Step) for commit in line.commits)


class FileLog:
    """Commits in a file, one JSON line each; see the module's page.

    Attributes:
        header: of the file.
        resumed: whether it held commits when it was opened.
    """

    def __init__(self, path: Path, header: Header, sync: Sync = "never") -> None:
        """Open a run's log, or begin it. InvalidFileError if the file is the log of another run or problem."""
        self.path, self.header, self._sync = path, header, sync
        lines, end = _whole_lines(path) if path.exists() else ([], 0)
        if lines and lines[0] != header:
            raise InvalidFileError(path, "", "the log of this run and problem", _difference(lines[0], header))
        self.resumed = any(isinstance(line, Step) for line in lines)
        self._file: IO[bytes] = path.open("r+b" if path.exists() else "w+b")
        self._file.truncate(end)
        self._file.seek(end)
        if not lines:
            self._write(header)

    def append(self, line: Resumed | Step | Accepted) -> None:
        """See CommitLog.append."""
        self._write(line)

    def _write(self, line: Line) -> None:
        self._file.write(_encoder.encode(line) + b"\n")
        self._file.flush()
        if self._sync == "commit":
            os.fsync(self._file.fileno())

    def commits(self) -> Iterator[Commit]:
        """See CommitLog.commits."""
        return (commit for line in read_log(self.path) if isinstance(line, Step) for commit in line.commits)

    def played(self) -> list[Step | Accepted]:
        """What was applied at once and what was ordered, in order."""
        return played(read_log(self.path))

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def played(lines: Iterable[Line]) -> list[Step | Accepted]:
    """The lines of a log that change the plant or bind the team."""
    return [line for line in lines if isinstance(line, Step | Accepted)]


def team_orders(lines: Iterable[Step | Accepted]) -> list[Team]:
    """The orders about the team, in order."""
    return [line.order for line in lines if isinstance(line, Accepted) and isinstance(line.order, Team)]


def read_log(path: Path) -> list[Line]:
    """All whole lines of a log; InvalidFileError if one of them is no line of a log."""
    return _whole_lines(path)[0]


def _whole_lines(path: Path) -> tuple[list[Line], int]:
    """The lines, and where the last one ends."""
    content = path.read_bytes()
    end = content.rfind(b"\n") + 1
    lines: list[Line] = []
    for number, text in enumerate(content[:end].splitlines(), 1):
        try:
            lines.append(_decoder.decode(text))
        except msgspec.DecodeError as error:
            raise InvalidFileError(path, f"line {number}", f"a line of a run's log ({error})", text[:60]) from error
    if lines and not isinstance(lines[0], Header):
        raise InvalidFileError(path, "line 1", "what is played", type(lines[0]).__name__)
    if any(isinstance(line, Header) for line in lines[1:]):
        raise InvalidFileError(path, "", "one run", "several")
    return lines, end


def _difference(found: Line, expected: Header) -> str:
    if not isinstance(found, Header):
        return "no header"
    ours, theirs = (
        {**one.problem, "run": one.run, "conflict": one.conflict, "plant": one.plant} for one in (expected, found)
    )
    pairs = {name: (theirs.get(name), value) for name, value in ours.items()}
    pairs["identity"] = (found.identity, expected.identity)
    return ", ".join(f"{name} {was!r} instead of {now!r}" for name, (was, now) in pairs.items() if was != now)


def play_again(plant: Plant, lines: Iterable[Step | Accepted], path: Path) -> int:
    """Apply logged commits and orders to a fresh plant; how many commits there were.

    Orders about the team are not the plant's. InvalidFileError where a line comes out otherwise.
    """
    count = 0
    for line in lines:
        if isinstance(line, Accepted):
            reason = None if isinstance(line.order, Team) else plant.order(line.order)
            if reason is not None:
                raise InvalidFileError(path, f"order {line.order.request}", f"accepted, not: {reason}", line.order.kind)
            continue
        choices = [
            Choice(c.agent, c.action, c.outcome if c.outcome in _FORCED else Outcome.DECIDED) for c in line.commits
        ]
        again = plant.apply(choices)
        if again != line.commits:
            raise InvalidFileError(path, f"commit {count + 1}", f"what this version plays: {again}", line.commits)
        count += len(again)
    return count
