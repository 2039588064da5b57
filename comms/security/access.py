"""Who may say and hear what, as access rules of Zenoh: everything that is not allowed here is denied.

With certificates a rule is bound to the common name of the certificate, so an agent speaks under its own key only and
hears what its view allows and nothing else. Without them all who connect have the same rights: those of all agents.
The rules are those of the node that everybody connects to, the world's session.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from marl_sched.comms.protocol import keys
from marl_sched.comms.security.identity import OBSERVER, OPERATOR, ROUTER, WORLD

_SUBSCRIBE = ["declare_subscriber"]
_ALL = [
    "put", "delete", "query", "reply", "declare_subscriber", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
]  # fmt: skip
_WATCH = ["declare_liveliness_subscriber", "liveliness_query"]


def named_rules(run: str, prefix: str, channels: Sequence[Sequence[str]]) -> dict[str, Any]:
    """Access rules for agents `<prefix>_<i>`, who may hear `channels[i]`, observers and operators, by certificate."""
    return _named(run, prefix, channels).section()


def router_rules(run: str, prefix: str, channels: Sequence[Sequence[str]]) -> dict[str, Any]:
    """The same for a router, which also passes on all that the world and other routers say, ask and hear."""
    rules = _named(run, prefix, channels)
    for name in (WORLD, ROUTER):
        for flow in ("ingress", "egress"):
            rules.add(name, f"route {flow}", flow, _ALL, ["**"])
    return rules.section()


def _named(run: str, prefix: str, channels: Sequence[Sequence[str]]) -> _Rules:
    rules = _Rules(keys.run_prefix(run))
    for agent, heard in enumerate(channels):
        rules.add_agent(f"{prefix}_{agent}", keys.AgentKeys(prefix), str(agent), heard)
    rules.add(OBSERVER, "hear", "ingress", _SUBSCRIBE, [keys.CLOCK, keys.OBSERVED])
    rules.add(OBSERVER, "told", "egress", ["put"], [keys.CLOCK, keys.OBSERVED])
    rules.add_hub(OBSERVER)
    rules.add(OPERATOR, "order", "ingress", ["query"], [keys.COMMAND])
    rules.add(OPERATOR, "answered", "egress", ["reply"], [keys.COMMAND])
    rules.add_hub(OPERATOR)
    return rules


def open_rules(run: str, prefix: str) -> dict[str, Any]:
    """Access rules without certificates: whoever connects may say what agents say, and hears what the world says."""
    root = keys.run_prefix(run)
    agents = keys.AgentKeys(prefix)
    rules = _Rules(root)
    anybody = ""
    rules.add_agent(anybody, agents, "*", ["**"])
    rules.add(anybody, "listen", "ingress", _SUBSCRIBE + _WATCH, ["**"], everywhere=True)
    rules.add(anybody, "private", "egress", ["put"], [agents.hello("*"), agents.decision("*")], permission="deny")
    return rules.section()


class _Rules:
    """Rules, and the subjects that they hold for; a name is a certificate's, "" anybody's."""

    def __init__(self, root: str) -> None:
        self._root = root
        self._rules: list[dict[str, Any]] = []
        self._of: dict[str, list[str]] = {}

    def add(
        self,
        name: str,
        what: str,
        flow: str,
        messages: Sequence[str],
        key_exprs: Sequence[str],
        *,
        permission: str = "allow",
        everywhere: bool = False,
    ) -> None:
        """One more rule for a subject; keys without the run's prefix, unless they hold `everywhere`."""
        root = "" if everywhere else self._root
        rule = {"permission": permission, "flows": [flow], "messages": list(messages)}
        self._rules.append({"id": f"{what} {name}", **rule, "key_exprs": [root + key for key in key_exprs]})
        self._of.setdefault(name, []).append(f"{what} {name}")

    def add_agent(self, name: str, agents: keys.AgentKeys, agent: str, heard: Sequence[str]) -> None:
        """What an agent may say, ask and hear; `agent` is its index, or `*`."""
        told = [keys.CLOCK, agents.turn(agent), *heard]
        asked = [keys.FRAME, keys.snapshot(agent)]
        self.add(name, "say", "ingress", ["put"], [agents.hello(agent), agents.decision(agent)])
        self.add(name, "token", "ingress", ["liveliness_token"], [agents.alive(agent, "*")])
        self.add(name, "ask", "ingress", ["query"], asked)
        self.add(name, "hear", "ingress", _SUBSCRIBE, told)
        self.add(name, "told", "egress", ["put"], told)
        self.add(name, "answered", "egress", ["reply"], asked)
        self.add_hub(name)

    def add_hub(self, name: str) -> None:
        """What everybody is told of the world: that it lives, what it listens to and what it answers."""
        self.add(name, "watch", "ingress", _WATCH, [keys.WORLD_ALIVE])
        self.add(name, "world", "egress", ["liveliness_token"], [keys.WORLD_ALIVE])
        self.add(name, "listens", "egress", ["declare_subscriber", "declare_queryable"], ["**"])

    def section(self) -> dict[str, Any]:
        """The section `access_control` of Zenoh's configuration."""
        subjects = [{"id": name or "anybody", **({"cert_common_names": [name]} if name else {})} for name in self._of]
        policies = [{"rules": rules, "subjects": [name or "anybody"]} for name, rules in self._of.items()]
        return {
            "enabled": True,
            "default_permission": "deny",
            "rules": self._rules,
            "subjects": subjects,
            "policies": policies,
        }
