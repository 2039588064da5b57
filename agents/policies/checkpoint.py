"""A trained policy as two files: weights in NAME.safetensors, its card in NAME.json. Nothing is ever unpickled."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.agents.networks.registry import config_of_card
from marl_sched.agents.policies.cards import PolicyCard, read_card, write_card
from marl_sched.errors import InvalidFileError, MarlSchedError
from marl_sched.files import replacing


def save_network(path: str | Path, network: PolicyNetwork, card: PolicyCard) -> None:
    """Write `path` (NAME.safetensors) and the card beside it, each whole or not at all.

    The card is written last and holds the weights' hash, so weights and a card that do not belong together,
    which a crash between the two can leave, are refused when they are read.
    """
    path = Path(path)
    weights = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    data = safetensors.torch.save(weights)
    with replacing(path) as temporary:
        temporary.write_bytes(data)
    write_card(path.with_suffix(".json"), msgspec.structs.replace(card, weights_sha256=_sha256(data)))


def load_network(path: str | Path) -> tuple[PolicyNetwork, PolicyCard]:
    """The network and the card of a policy, from the path of either file.

    Raises InvalidFileError for a file that is missing, truncated, malformed or not the other's.
    """
    weights_path, card_path = Path(path).with_suffix(".safetensors"), Path(path).with_suffix(".json")
    card = read_card(card_path)
    try:
        # shapes without memory, until they are known to be those of the weights
        with torch.device("meta"), _Undrawn():
            network = config_of_card(card.sizes).build(card.graph)
    except msgspec.ValidationError as error:
        reason, _, where = str(error).partition(" - at `$.")
        raise InvalidFileError(card_path, where.rstrip("`"), f"sizes of a network ({reason})") from error
    except MarlSchedError as error:
        raise InvalidFileError(card_path, "sizes", f"a registered network that fits its graph ({error})") from error
    weights = _read_weights(weights_path, card)
    expected = network.state_dict()
    for name in sorted(expected.keys() | weights.keys()):
        want, got = _shape(expected.get(name)), _shape(weights.get(name))
        if want != got:
            raise InvalidFileError(weights_path, name, want, got)
    network.to_empty(device="cpu").load_state_dict(weights)
    return network, card


class _Undrawn(TorchFunctionMode):
    """Leaves out the drawing of initial weights: on the meta device it would import torch._dynamo, 0.9 s of CPU."""

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        """What torch calls instead of each of its functions."""
        if func in (Tensor.uniform_, Tensor.normal_) or getattr(func, "__module__", "") == nn.init.__name__:
            return (*args, *(kwargs or {}).values())[0]
        return func(*args, **(kwargs or {}))


def _read_weights(path: Path, card: PolicyCard) -> dict[str, Tensor]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InvalidFileError(path, "", f"a readable file ({error.strerror})") from error
    try:
        weights = safetensors.torch.load(data)
    except SafetensorError as error:
        raise InvalidFileError(path, "", f"a whole safetensors file ({error})") from error
    if _sha256(data) != card.weights_sha256:
        raise InvalidFileError(path, "", f"the weights of its card (SHA-256 {card.weights_sha256})", _sha256(data))
    return weights


def _shape(tensor: Tensor | None) -> str:
    return "no tensor of that name" if tensor is None else f"{tensor.dtype} of shape {tuple(tensor.shape)}"


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
