"""Schedulers that decide for themselves: aircraft maintenance (AirME), human-robot teams (MuRSE), a delivery ward.

    import marl_sched

    env = marl_sched.airme_v0.env()                         # PettingZoo AEC
    policy = marl_sched.load_policy("airme-local-profit")   # needs torch, the environments do not

Importing this package imports nothing else; each name is loaded when it is first used. Its environments are registered
with Gymnasium and PettingZoo as soon as these are imported, before or after it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from marl_sched.when_imported import when_imported as _when_imported

if TYPE_CHECKING:
    from marl_sched import airme_v0 as airme_v0
    from marl_sched import murse_v0 as murse_v0
    from marl_sched import ward_v0 as ward_v0
    from marl_sched.agents import load_policy as load_policy

    __version__: str

_MODULES = ("airme_v0", "murse_v0", "ward_v0")
_ATTRIBUTES = {"load_policy": "marl_sched.agents"}

__all__ = ["__version__", "airme_v0", "load_policy", "murse_v0", "ward_v0"]


def __getattr__(name: str) -> Any:
    """The public names, imported on first use (PEP 562)."""
    if name in _MODULES:
        return import_module(f"marl_sched.{name}")
    if name in _ATTRIBUTES:
        return getattr(import_module(_ATTRIBUTES[name]), name)
    if name == "__version__":
        from importlib.metadata import version

        return version("marl-sched")
    stem, _, number = name.rpartition("_v")
    versions = [module for module in _MODULES if module.rpartition("_v")[0] == stem and number.isdigit()]
    if versions:
        raise AttributeError(f"marl_sched has no {name}; the versions of this environment are {', '.join(versions)}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))


_when_imported("gymnasium", lambda: import_module("marl_sched.gymnasium_ids").register())
_when_imported("pettingzoo", lambda: import_module("marl_sched.pettingzoo_ids").register())
