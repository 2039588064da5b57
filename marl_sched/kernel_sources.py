"""What a module's kernels are made from: the files that it imports, and a digest of them.

A kernel compiles in what it calls and the constants that it reads, wherever these stand. So the sources of a module are
its own file and every file that it imports, directly or not, of `marl_sched` or of its own distribution's package.
Imports within functions do not count: a kernel cannot use them.
"""

from __future__ import annotations

import functools
import hashlib
import re
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numba

# The rooms of a checkout lie beside the package, those of a wheel within it: each is found by its own name.
_PACKAGE = "marl_sched"
_IMPORT = re.compile(r"^(?:from ([\w.]+) import (\([^)]*\)|[^\n]*)|import ([\w.]+))", re.MULTILINE)
_NAME = re.compile(r"[A-Za-z_]\w*")


@functools.cache
def sources(module: str) -> dict[str, Path]:
    """The files that a module is made from, by their modules' names, sorted; its own among them.

    Empty for a module that has no file.
    """
    top = module.partition(".")[0]
    found: dict[str, Path] = {}
    left = [module]
    while left:
        name = left.pop()
        file = None if name in found else _file(name)
        if file is not None:
            found[name] = file
            left += [other for other in _imports(file) if other.partition(".")[0] in (_PACKAGE, top)]
    return dict(sorted(found.items()))


@functools.cache
def sources_digest(*modules: str) -> str:
    """The first 16 hex digits of a SHA-256 over the files that modules are made from, and Numba's version.

    It does not depend on where the files lie or when they were written.
    """
    files = {name: file for module in modules for name, file in sources(module).items()}
    digest = hashlib.sha256(f"numba {numba.__version__}".encode())
    for name, file in sorted(files.items()):
        digest.update(name.encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


@functools.cache
def _imports(file: Path) -> tuple[str, ...]:
    """The names of modules that a file may import at its top level: `a` and `a.b` for `from a import b`."""
    return tuple(_imported(file.read_text(encoding="utf-8")))


def _imported(text: str) -> Iterator[str]:
    for module, names, plain in _IMPORT.findall(text):
        yield module or plain
        for name in _NAME.findall(names):
            yield f"{module}.{name}"


@functools.cache
def _file(module: str) -> Path | None:
    """The source file of a module or package; None if there is none, as for a name that is no module."""
    parts = module.split(".")
    depth = 2 if parts[0] == _PACKAGE and len(parts) > 1 and _folder(".".join(parts[:2])) else 1
    package = ".".join(parts[:depth])
    folder = _folder(package)
    if folder is None:
        loaded = getattr(sys.modules.get(package), "__file__", None)
        return Path(loaded) if len(parts) == 1 and loaded else None
    base = folder.joinpath(*parts[depth:])
    for file in (base / "__init__.py", base.with_suffix(".py") if len(parts) > depth else base / "__init__.py"):
        if file.is_file():
            return file
    return None


@functools.cache
def _folder(package: str) -> Path | None:
    """The folder of a package; None for a module, or where there is none of that name."""
    loaded = sys.modules.get(package)
    if loaded is not None:
        places = list(getattr(loaded, "__path__", []))
    else:
        spec = find_spec(package)
        places = list((spec.submodule_search_locations if spec is not None else None) or [])
    return Path(places[0]) if places else None
