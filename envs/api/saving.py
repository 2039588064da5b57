"""Saving where an environment stands and returning to it: for lookahead, tree search and restarts.

    saved = env.save_state()
    ...                          # try something
    env.load_state(saved)        # and go on as if nothing had happened, to the last bit

Environments can also be copied by `copy.deepcopy`, `pickle` and `cloudpickle`; a saved state is smaller and quicker,
and can itself be pickled.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from marl_sched.errors import IllegalActionError, InvalidOptionError
from marl_sched.simulation import SavedState, TurnSimulator


@dataclass(frozen=True)
class SavedEnvironment:
    """Where an environment stands: copies, to which it can return any number of times.

    Attributes:
        kind: class of the environment that saved it.
        simulator: where its simulator stands.
        attributes: copies of its own attributes that change, by name.
    """

    kind: str
    simulator: SavedState
    attributes: Mapping[str, Any]


class SavesState:
    """An environment that can return to where it stood; a subclass names its attributes that change.

    Attributes:
        changing: names of those attributes; `a.b` is attribute b of attribute a.
    """

    changing: ClassVar[tuple[str, ...]]
    simulator: TurnSimulator

    def save_state(self) -> SavedEnvironment:
        """A copy of where the episode stands; IllegalActionError before the first reset."""
        try:
            attributes = {name: copy.deepcopy(getattr(*_owner(self, name))) for name in self.changing}
        except AttributeError as error:
            raise IllegalActionError("save_state: no episode has begun, call reset()") from error
        return SavedEnvironment(type(self).__name__, self.simulator.save_state(), attributes)

    def load_state(self, saved: SavedEnvironment) -> None:
        """Return to a saved state, of this environment or of one that was made with the same options.

        Raises InvalidOptionError, and changes nothing, for a state of another kind of environment or other sizes.
        """
        if not isinstance(saved, SavedEnvironment) or saved.kind != type(self).__name__:
            got = saved.kind if isinstance(saved, SavedEnvironment) else type(saved).__name__
            raise InvalidOptionError(f"load_state: expected a state of {type(self).__name__}, got one of {got}")
        self.simulator.load_state(saved.simulator)
        for name, value in saved.attributes.items():
            setattr(*_owner(self, name), copy.deepcopy(value))


def _owner(thing: Any, path: str) -> tuple[Any, str]:
    """The object that has the attribute a dotted path ends in, and the attribute's name."""
    *parents, name = path.split(".")
    for parent in parents:
        thing = getattr(thing, parent)
    return thing, name
