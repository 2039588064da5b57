"""Cells as earlier versions wrote them."""

from __future__ import annotations

from typing import Any

from marl_sched.privileged import PrivilegedInfo


def with_names(cell: Any) -> Any:
    """A cell as plain data, with the names of `privileged_info` in the place of the words of `needs` (version 0.1.0).

    Raises UnknownNameError for words that no part of PrivilegedInfo has.
    """
    if not isinstance(cell, dict) or "needs" not in cell:
        return cell
    known = PrivilegedInfo.of_words(str(cell["needs"])).names
    return {**{name: value for name, value in cell.items() if name != "needs"}, "privileged_info": known}
