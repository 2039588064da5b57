"""Settings of every test, and kernels that are compiled once before several processes run tests."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import settings

# A kernel's first call compiles it and would miss any deadline; the same commit tries the same examples.
settings.register_profile("marl_sched", deadline=None, derandomize=True)
settings.load_profile("marl_sched")

# Ray's workers are nice to others by default, and starve beside the other processes that run tests.
os.environ.setdefault("RAY_worker_niceness", "0")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Where tests run in several processes, compile first, a process for each domain."""
    config = session.config
    if hasattr(config, "workerinput") or not getattr(config.option, "numprocesses", None):
        return
    warm = Path(__file__).with_name("warm.py")
    running = [subprocess.Popen([sys.executable, "-P", str(warm), domain]) for domain in ("airme", "murse", "ward")]
    codes = [process.wait() for process in running]
    if any(codes):
        raise pytest.UsageError("compiling the kernels failed; see above")
