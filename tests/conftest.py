"""Settings of every test."""

from hypothesis import settings

# A kernel's first call compiles it and would miss any deadline; the same commit tries the same examples.
settings.register_profile("marl_sched", deadline=None, derandomize=True)
settings.load_profile("marl_sched")
