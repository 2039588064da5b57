"""Compiled kernels: Numba's `njit` with a cache that notices an edit in any source of a kernel.

Numba keys its file cache by the file that holds a function, so a kernel that calls one from another file keeps the
old code of the other when that is edited. Kernels of this package are therefore cached in a folder that is named after
their module and a digest of everything that the module is made from (marl_sched.kernel_sources):

    <NUMBA_CACHE_DIR, or the user's cache directory>/marl_sched/kernels/<module>-<digest>

The digest stands for the sources, wherever they lie and whenever they were written: another checkout, a new
installation of the same version or an image that was built from it finds what is compiled already.

A cache directory that cannot be written (a read-only installation without a home) is replaced by one in the folder
for temporary files; a cache file that is damaged is compiled anew; a full disk costs the cache, not the run. Each is
logged as a warning on the logger `marl_sched.kernels`.
"""

from __future__ import annotations

import functools
import logging
import os
import pickle  # noqa: TID251  (Numba's own cache files are pickles; here only their errors are named)
import stat
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import platformdirs
from numba.core.caching import CacheImpl, CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.dispatcher import Dispatcher

from marl_sched.kernel_sources import sources, sources_digest

log = logging.getLogger(__name__)

_UNUSED_AFTER = 30 * 24 * 3600  # seconds
_DAMAGED = (EOFError, pickle.UnpicklingError, AttributeError, ImportError, IndexError, KeyError, TypeError, ValueError)


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function with `numba.njit` and keep the machine code in the package's cache.

    Use as `@kernel`, or with options of `numba.njit` such as `@kernel(inline="always")`.
    """
    if function is None:
        return functools.partial(kernel, **options)
    dispatcher: Any = numba.njit(**options)(function)
    if isinstance(dispatcher, Dispatcher):  # with NUMBA_DISABLE_JIT it is the plain function
        setattr(dispatcher, "_cache", _cache_of(function))  # noqa: B010  (not in Numba's stubs)
    return dispatcher


def _cache_of(function: Callable[..., Any]) -> FunctionCache:
    """A cache in the package's folder; Numba reads the folder from its configuration when the cache is made."""
    config: Any = numba.config
    before, config.CACHE_DIR = config.CACHE_DIR, str(cache_folder())
    try:
        return _KernelCache(function)
    finally:
        config.CACHE_DIR = before


class _SourcesLocator(_CacheLocator):
    """Where a kernel's code is kept: by its module's name, fresh as long as the digest of the module's sources is."""

    def __init__(self, function: Any, file: str) -> None:
        self._py_file = file  # Numba's warnings name it
        self._module, self._line = function.__module__, function.__code__.co_firstlineno

    def get_cache_path(self) -> str:
        """The folder of the kernel's module."""
        return str(_module_folder(self._module))

    def get_source_stamp(self) -> str:
        """The digest of the module's sources."""
        return sources_digest(self._module)

    def get_disambiguator(self) -> str:
        """The line, for functions of one name in a module."""
        return str(self._line)

    @classmethod
    def from_function(cls, function: Any, file: str) -> _SourcesLocator | None:
        """None for a function of no file, such as one that was typed at a prompt: Numba has places for such."""
        return cls(function, file) if sources(function.__module__) else None


class _KernelCacheImpl(CompileResultCacheImpl):
    _locator_classes: list[type[object]] = [_SourcesLocator, *CacheImpl._locator_classes]  # noqa: RUF012  (as Numba has it)


class _KernelCache(FunctionCache):
    """Numba's cache of one function, for which a damaged file or a full disk is no reason to stop."""

    _impl_class = _KernelCacheImpl

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The machine code of a signature, None if there is none that can be read."""
        try:
            return super().load_overload(sig, target_context)
        except _DAMAGED as error:
            log.warning("the cached code of %s is damaged (%r): it is compiled anew", self._name, error)
        except OSError as error:
            log.warning("the cached code of %s cannot be read: %s", self._name, error)
            return None
        try:
            self.flush()
        except OSError as error:
            log.warning("the cached code of %s cannot be replaced: %s", self._name, error)
            self.disable()
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the machine code of a signature where that is possible."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            log.warning("compiled code cannot be kept in %s: %s", self.cache_path, error)
            self.disable()


@functools.cache
def cache_folder() -> Path:
    """Where compiled kernels are kept, made if it was not there; see the module's page."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    usual = Path(given) / "marl_sched" if given else platformdirs.user_cache_path("marl_sched")
    for parent, private in ((usual, False), (Path(tempfile.gettempdir()) / f"marl_sched-{_user()}", True)):
        folder = parent / "kernels"
        try:
            parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            if private and not _is_ours(parent):
                continue
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError as error:
            log.warning("compiled kernels cannot be kept in %s: %s", folder, error)
            continue
        _remove_unused(folder)
        return folder
    return Path(tempfile.mkdtemp(prefix="marl_sched-kernels-"))


@functools.cache
def _module_folder(module: str) -> Path:
    """Where the kernels of a module are kept, touched, so that it counts as used."""
    folder = cache_folder() / f"{module}-{sources_digest(module)}{_settings()}"
    try:
        folder.mkdir(exist_ok=True)
        os.utime(folder)
    except OSError as error:  # a full disk: what is compiled is not kept, which the cache says when it tries to
        log.debug("%s cannot be made or touched: %s", folder, error)
    return folder


def _settings() -> str:
    """What of Numba's settings makes other code of the same sources; "" for the usual ones."""
    config: Any = numba.config
    checked, debug, level = bool(config.BOUNDSCHECK), bool(config.DEBUGINFO_DEFAULT), int(config.OPT)
    return (
        ("-boundscheck" if checked else "") + ("-debuginfo" if debug else "") + (f"-opt{level}" if level != 3 else "")
    )


def _user() -> str:
    return str(os.getuid()) if hasattr(os, "getuid") else "user"


def _is_ours(folder: Path) -> bool:
    """Whether nobody else can put code into a folder among the temporary files, from which code is loaded."""
    if not hasattr(os, "getuid"):
        return True
    about = folder.lstat()
    return stat.S_ISDIR(about.st_mode) and about.st_uid == os.getuid() and not about.st_mode & 0o022


def _remove_unused(folder: Path) -> None:
    """Remove the kernels of sources that nobody has used for a month."""
    for other in folder.iterdir():
        if other.is_dir() and time.time() - other.stat().st_mtime > _UNUSED_AFTER:
            for path in sorted(other.rglob("*"), reverse=True):
                _remove(path)
            _remove(other)


def _remove(path: Path) -> None:
    try:
        path.rmdir() if path.is_dir() else path.unlink()
    except OSError as error:  # another process may have been first
        log.debug("%s stays: %s", path, error)
