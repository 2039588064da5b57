"""Memory that a forward pass has given back, kept for the next one.

A network on a batch asks for megabytes and frees them with every operation. By default glibc gives such pieces back to
the operating system, which clears them before they are lent again: between a tenth and a half of the time of a forward
pass, more where several processes work side by side.
"""

from __future__ import annotations

import ctypes
import platform

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of malloc.h
_KEPT, _LARGEST = 2**30, 2**25  # bytes, in all and in a piece; older releases refuse larger pieces


def keep_freed_memory() -> bool:
    """Let this process keep up to a gigabyte of what it frees; whether its C library could be told so.

    For processes that run networks for long. What they compute does not change.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    libc = ctypes.CDLL(None)
    # In this order: with a trim threshold alone, pieces would be lent one by one that are now kept as they grow.
    return libc.mallopt(_MMAP_THRESHOLD, _LARGEST) == 1 and libc.mallopt(_TRIM_THRESHOLD, _KEPT) == 1
