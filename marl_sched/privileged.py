"""What deciding, or proving a bound, may use beyond what an agent sees."""

from __future__ import annotations

from collections.abc import Iterable
from enum import Flag, auto

from marl_sched.errors import require


class PrivilegedInfo(Flag):
    """What a scheduler knows beyond the acting agent's observation.

    `str` gives it in words for people, `names` in the names of its parts for files.
    """

    NONE = 0
    FAILURE_MODEL = auto()
    TIME_LEFT = auto()
    DURATIONS = auto()
    WAITS = auto()
    DEADLINES = auto()
    PLACES = auto()
    ARRIVALS = auto()

    def __str__(self) -> str:
        """The parts in words, such as "failure model and clock"; "" for nothing."""
        *first, last = [_IN_WORDS[part] for part in self] or [""]
        return f"{', '.join(first)} and {last}" if first else last

    @property
    def names(self) -> list[str]:
        """The names of the parts, such as `["failure_model", "time_left"]`."""
        return [str(part.name).lower() for part in self]

    @classmethod
    def of(cls, names: Iterable[str]) -> PrivilegedInfo:
        """What `names` gave; UnknownNameError for a name of no part."""
        known = {name.lower(): part for name, part in cls.__members__.items() if part}
        found = cls.NONE
        for name in names:
            found |= known[require("privileged information", name, known)]
        return found

    @classmethod
    def of_words(cls, text: str) -> PrivilegedInfo:
        """What `str` gave; UnknownNameError for other words."""
        known = {words: part for part, words in _IN_WORDS.items()}
        found = cls.NONE
        for words in text.replace(" and ", ", ").split(", ") if text else []:
            found |= known[require("privileged information", words, known)]
        return found


_IN_WORDS = {
    PrivilegedInfo.FAILURE_MODEL: "failure model",
    PrivilegedInfo.TIME_LEFT: "clock",
    PrivilegedInfo.DURATIONS: "all durations",
    PrivilegedInfo.WAITS: "waits",
    PrivilegedInfo.DEADLINES: "deadlines",
    PrivilegedInfo.PLACES: "places",
    PrivilegedInfo.ARRIVALS: "arrivals",
}
