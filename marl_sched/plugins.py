"""Parts from outside the package: entry points, objects named as `package.module:attribute`, and lazy parts.

A distribution offers a domain, a scheduler or an objective by an entry point of its `pyproject.toml`:

    [project.entry-points."marl_sched.domains"]
    couriers = "couriers.domain:COURIERS"

    [project.entry-points."marl_sched.schedulers"]
    "couriers.oldest-first" = "couriers.schedulers:OldestFirst"

Nothing of it is imported before it is asked for by name.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from marl_sched.errors import InvalidOptionError, MarlSchedError

DOMAINS, SCHEDULERS, OBJECTIVES = "marl_sched.domains", "marl_sched.schedulers", "marl_sched.objectives"


class Lazy:
    """Stands for the object `package.module:attribute`, which is imported when it is first called or looked into.

    A domain declares parts that most commands do not need in this way: rendering, telemetry, the joint action.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._found: Any = None

    def load(self) -> Any:
        """The object itself; raises as `import_object`."""
        if self._found is None:
            self._found = import_object(self._where)
        return self._found

    def __call__(self, *args: Any, **options: Any) -> Any:
        """Call the object."""
        return self.load()(*args, **options)

    def __getattr__(self, name: str) -> Any:
        """An attribute of the object. Private ones do not load it, so that a copy or a repr imports nothing."""
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self.load(), name)

    @property
    def __signature__(self) -> inspect.Signature:
        """The signature of the object, for `inspect.signature`."""
        return inspect.signature(self.load())

    def __repr__(self) -> str:
        """Names the object without importing it."""
        return f"Lazy({self._where!r})"


def lazy(where: str) -> Any:
    """A `Lazy` that type checkers take for whatever the object is declared as."""
    return Lazy(where)


def import_object(where: str) -> Any:
    """The object that `package.module:attribute` names.

    Raises InvalidOptionError where the text has another form, the module does not exist or lacks the attribute.
    What the module itself fails with is passed on.
    """
    module_name, found, path = where.partition(":")
    if not found or not module_name or not path:
        raise InvalidOptionError(f"{where}: expected package.module:attribute")
    try:
        owner: Any = import_module(module_name)
    except ModuleNotFoundError as error:
        missing = error.name or ""
        if module_name != missing and not module_name.startswith(f"{missing}."):
            raise
        raise InvalidOptionError(f"{where}: expected a module that can be imported, got {missing!r}") from error
    for name in path.split("."):
        if not hasattr(owner, name):
            raise InvalidOptionError(f"{where}: expected an attribute of {module_name}, got {path!r}")
        owner = getattr(owner, name)
    return owner


def is_object_name(text: str) -> bool:
    """Whether a text has the form `package.module:attribute`."""
    module_name, found, path = text.partition(":")
    parts = [*module_name.split("."), *path.split(".")]
    return bool(found) and all(part.isidentifier() for part in parts)


def offered(group: str) -> Mapping[str, EntryPoint]:
    """The entry points of a group by name; InvalidOptionError where two distributions offer the same name."""
    found: dict[str, EntryPoint] = {}
    for point in entry_points(group=group):
        other = found.setdefault(point.name, point)
        if other.value != point.value:
            raise InvalidOptionError(
                f"{group}: expected one distribution that offers {point.name!r}, got {other.value} and {point.value}"
            )
    return found


def load_offered(point: EntryPoint) -> Any:
    """The object behind an entry point; MarlSchedError names the distribution whose module cannot be imported."""
    try:
        return import_object(point.value)
    except InvalidOptionError as error:
        owner = point.dist.name if point.dist is not None else "an installed distribution"
        raise MarlSchedError(f"entry point {point.name} of {owner}: {error}") from error
