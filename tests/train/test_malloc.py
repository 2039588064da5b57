"""What a process frees stays with it: a second look at the same memory costs no page faults."""

import platform
import subprocess
import sys

import pytest

SCRIPT = """
import resource, sys
import numpy as np
from marl_sched.train.malloc import keep_freed_memory

if sys.argv[1] == "keep":
    assert keep_freed_memory()

def touch():
    for _ in range(5):
        arrays = [np.ones(2**20) for _ in range(8)]  # eight megabytes each
        del arrays

touch()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
touch()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(mode: str) -> int:
    """Page faults of five times eight arrays of eight megabytes, after as many before."""
    done = subprocess.run([sys.executable, "-c", SCRIPT, mode], capture_output=True, text=True, check=True)
    return int(done.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told")
def test_memory_that_was_freed_is_used_again_without_page_faults():
    assert faults("keep") < 100 < faults("default")
