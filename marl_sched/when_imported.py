"""Registers with a library when it is imported, so that importing `marl_sched` need not import it.

Gymnasium takes 0.2 s and 30 MB, which neither a command line nor a deployed agent without a simulator should pay.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType


def when_imported(name: str, call: Callable[[], None]) -> None:
    """Call a function once a top-level module has been imported: now, if it has been."""
    if name in sys.modules:
        call()
    else:
        sys.meta_path.insert(0, _AfterImport(name, call))


class _AfterImport(MetaPathFinder):
    """Finds nothing by itself; has what the other finders find call a function after it has been executed."""

    def __init__(self, name: str, call: Callable[[], None]) -> None:
        self._name, self._call = name, call

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The spec that the other finders have, for this one module."""
        if fullname != self._name:
            return None
        sys.meta_path.remove(self)
        spec = find_spec(fullname)
        if spec is not None and spec.loader is not None:
            execute, call = spec.loader.exec_module, self._call

            def execute_and_call(module: ModuleType) -> None:
                execute(module)
                call()

            spec.loader.exec_module = execute_and_call  # type: ignore[method-assign]  # of this one loader
        return spec
