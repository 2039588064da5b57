"""One folder per scheduling domain, and the environment APIs that every domain gets for free."""

from marl_sched.envs.airme import domain as _airme  # noqa: F401  (registers the domain)
from marl_sched.envs.murse import domain as _murse  # noqa: F401  (registers the domain)
