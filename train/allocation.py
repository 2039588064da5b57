"""Memory that a forward pass has given back, kept for the next one.

A network on a batch asks for megabytes and frees them with every operation. By default glibc gives such pieces back to
the operating system, which clears them before they are lent again: between a tenth and a half of the time of a forward
pass, more where several processes work side by side.
"""

from __future__ import annotations

import ctypes
import platform

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of malloc.h
_KEPT = 2**30  # bytes


def keep_freed_memory() -> bool:
    """Let this process keep up to a gigabyte of what it frees; whether its C library can be told so (glibc can).

    For processes that run networks for long. What they compute does not change.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    libc = ctypes.CDLL(None)
    return all(libc.mallopt(option, _KEPT) == 1 for option in (_TRIM_THRESHOLD, _MMAP_THRESHOLD))
