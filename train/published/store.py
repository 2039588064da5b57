"""Cells in one file: a JSON line for each, sorted by the hash of its inputs.

    docs/results/airme/cells.jsonl

A cell also says from which sources its domain's simulator and rules were made (`kernels_of`). Under other sources it is
stale: it may still be drawn, and before it is mixed with new ones a sample of the stale cells is played again
(`confirm`). If all of the sample agree the others are taken over, otherwise every stale cell is made anew.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import msgspec
from filelock import FileLock

from marl_sched.errors import InvalidFileError, UnknownNameError
from marl_sched.files import replacing
from marl_sched.train.published.cells import SCHEMA, Bound, Cell, Inputs, Job, describe, digest, kernels_of, make
from marl_sched.train.published.earlier import with_names


class Cells:
    """The cells of a file, which need not be there yet.

    Args:
        path: the file. It is read once; what another process adds meanwhile is kept when this one writes.

    Raises InvalidFileError, with the line, for a line that is no cell, that stands twice, or whose scores do not match
    its inputs.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._cells = self._load()

    def _load(self) -> dict[str, Cell]:
        found: dict[str, Cell] = {}
        if not self.path.exists():
            return found
        for number, line in enumerate(self.path.read_bytes().splitlines(), start=1):
            try:
                cell = msgspec.convert(with_names(msgspec.json.decode(line)), Cell)
                _ = cell.knows  # a name that nobody has is refused here, with the line
            except (msgspec.DecodeError, UnknownNameError) as error:
                raise InvalidFileError(self.path, f"line {number}", f"a cell of schema {SCHEMA} ({error})") from error
            name = digest(cell.inputs)
            if name in found:
                raise InvalidFileError(self.path, f"line {number}", "a cell that is not there yet", name)
            if len(cell.M1) != cell.inputs.instances:
                expected = f"{cell.inputs.instances} numbers"
                raise InvalidFileError(self.path, f"line {number}: M1", expected, len(cell.M1))
            found[name] = cell
        return found

    def read(self, inputs: Inputs) -> Cell | None:
        """The cell of these inputs, None if there is none yet."""
        return self._cells.get(digest(inputs))

    def write(self, *cells: Cell) -> None:
        """Keep cells in place of those with the same inputs; the file is replaced as a whole."""
        self._change({digest(cell.inputs): cell for cell in cells}, ())

    def remove(self, *inputs: Inputs) -> None:
        """Forget the cells of these inputs, if they are there."""
        self._change({}, [digest(one) for one in inputs])

    def _change(self, new: Mapping[str, Cell], gone: Iterable[str]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(self.path.with_name(f".{self.path.name}.lock")):
            self._cells = {**self._load(), **new}
            for name in gone:
                self._cells.pop(name, None)
            lines = io.BytesIO()
            for name in sorted(self._cells):
                lines.write(msgspec.json.encode(self._cells[name]) + b"\n")
            with replacing(self.path) as temporary:
                temporary.write_bytes(lines.getvalue())

    def __len__(self) -> int:
        """How many cells there are."""
        return len(self._cells)

    def __iter__(self) -> Iterator[Cell]:
        """All cells, in the order of the file."""
        return iter(self._cells.values())

    def stale(self) -> list[Cell]:
        """The cells that were made with other kernels than those of the running source."""
        return [cell for cell in self if cell.kernels != kernels_of(cell.inputs.env)]

    def revisions(self) -> dict[str, int]:
        """Source revision -> how many of the cells it made, most first."""
        return dict(Counter(cell.revision for cell in self).most_common())


def confirm(cells: Cells, jobs: Iterable[Job], sample: int) -> list[str]:
    """Play the `sample` cheapest stale cells of rules again; what differs, in words, empty if nothing does.

    Where all agree, to the last of the six decimals, every stale cell is marked as made with the present kernels.
    Where one differs, all stale cells are forgotten. Cells of networks are not played for this: kernels are what may
    have changed, and a network's choices differ between processors.
    """
    stale = {digest(cell.inputs): cell for cell in cells.stale()}
    if not stale:
        return []
    kinds = [job for job in jobs if job.weights is None and digest(job.inputs) in stale]
    chosen = sorted((job for job in kinds if not isinstance(job.inputs, Bound)), key=lambda job: job.cost)[:sample]
    differing = []
    for job in chosen:
        (again,) = make(Job(job.inputs))
        if again.M1 != stale[digest(job.inputs)].M1:
            differing.append(describe(job.inputs))
    if differing or not chosen:
        cells.remove(*(cell.inputs for cell in stale.values()))
    else:
        cells.write(*(msgspec.structs.replace(cell, kernels=kernels_of(cell.inputs.env)) for cell in stale.values()))
    return differing
