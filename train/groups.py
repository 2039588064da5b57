"""The groups of the configuration that follow from the domain: `env`, `view` and `curriculum=whole`.

They are made from the domain's declaration, so that one of another distribution can be trained like those that ship,
and its views bring their own options: `view=local view.reach=2`.
"""

from __future__ import annotations

from collections.abc import Sequence

from hydra.core.config_store import ConfigStore

from marl_sched.domain import Domain, get_domain
from marl_sched.envs import DOMAINS

DEFAULT_ENV = next(iter(DOMAINS))


def chosen_domain(overrides: Sequence[str]) -> Domain:
    """The domain of the last override `env=NAME`, or the first that ships; UnknownNameError for an unknown one."""
    names = [override.partition("=")[2] for override in overrides if override.startswith("env=")]
    return get_domain(names[-1] if names else DEFAULT_ENV)


def offer(domain: Domain) -> None:
    """Make the domain's groups known to Hydra, in the place of those of another domain.

    `env=NAME` is the domain with its smallest scale and its first objective, `view=KIND` a view with the defaults of
    its options, `curriculum=whole` plays episodes of the domain's default length.
    """
    store = ConfigStore.instance()
    for group in ("env", "view"):
        store.repo.pop(group, None)
    env = {"name": domain.name, "scales": [next(iter(domain.scales))], "objective": domain.objectives[0], "options": {}}
    store.store(group="env", name=domain.name, node=env)
    for kind in domain.views:
        store.store(group="view", name=kind, node={"kind": kind, **domain.view_options(kind)})
    length = domain.default_horizon
    store.store(group="curriculum", name="whole", node={"start": length, "step": 0.0, "stop": length, "spread": 0})
