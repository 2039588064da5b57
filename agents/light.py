"""Schedulers by name for agents that carry neither Numba nor PyTorch (marl_sched.light)."""

from __future__ import annotations

from marl_sched.agents.base import ObservationScheduler
from marl_sched.agents.policies.cards import read_card
from marl_sched.agents.recurrent import RecurrentScheduler
from marl_sched.agents.registry import is_policy, policy_path, shipped_policies
from marl_sched.errors import InvalidFileError, MarlSchedError, UnknownNameError
from marl_sched.light import LightDomain


def create_light_scheduler(name_or_path: str, domain: LightDomain) -> ObservationScheduler | RecurrentScheduler:
    """A rule of the light domain by its name, or a trained policy, run by onnxruntime, by its name or path.

    Raises UnknownNameError for a name that is neither, InvalidFileError for a file that is damaged or of another
    domain, MarlSchedError without onnxruntime.
    """
    rules = domain.rules()
    if name_or_path in rules:
        made: ObservationScheduler = rules[name_or_path]()
        return made
    if not is_policy(name_or_path):
        raise UnknownNameError(f"scheduler of {domain.name} without Numba", name_or_path, [*rules, *shipped_of(domain)])
    path = policy_path(name_or_path)
    card_path = path.with_suffix(".json")
    if (found := read_card(card_path).domain) != domain.name:
        raise InvalidFileError(card_path, "domain", f"a policy for {domain.name}", found)
    try:
        from marl_sched.agents.policies.onnx_policy import load_onnx
    except ModuleNotFoundError as error:
        if error.name != "onnxruntime":
            raise
        raise MarlSchedError(
            f"policy {name_or_path}: expected onnxruntime to be installed: pip install 'marl-sched[light]'"
        ) from error
    return load_onnx(path, pressing=domain.pressing)


def shipped_of(domain: LightDomain) -> list[str]:
    """The names of the policies of a domain that ship with the package."""
    return [name for name, card in shipped_policies().items() if card.domain == domain.name]
