"""A trained network as a scheduler that onnxruntime runs, where PyTorch need not be installed.

`marl-sched export-onnx` writes NAME.onnx beside a policy's weights and card. It holds the card's hash of the weights
that it was made from, so that one of other weights is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import onnxruntime

from marl_sched.agents.policies.cards import Mode, PolicyCard, check_graph, read_card
from marl_sched.agents.policies.trained import LogitsPolicy, Observation, PolicyOptions, Pressing, TrainedPolicy
from marl_sched.agents.recurrent import RecurrentScheduler
from marl_sched.errors import InvalidFileError, InvalidOptionError
from marl_sched.graph import ACTION_MASK, GraphSpec

WEIGHTS = "weights_sha256"  # what the file's metadata call the hash of the weights
LOGITS, MEMORY, NEW_MEMORY = "logits", "memory", "new_memory"
BLOCK = 512  # observations in one pass; its activations stay within some tens of MB
_ERRORS_ONLY = 3

Run = Callable[[Mapping[str, np.ndarray]], list[np.ndarray]]  # arrays with B rows -> outputs with B rows


class OnnxPolicy(LogitsPolicy):
    """Decides by a network that carries no memory; see TrainedPolicy.

    Its logits are those of PyTorch within 1e-5, so that choices differ at most between actions that are as good.
    """

    def __init__(
        self, session: onnxruntime.InferenceSession, graph: GraphSpec, **options: Unpack[PolicyOptions]
    ) -> None:
        super().__init__(graph, **options)
        self._run = runner(session)

    def logits(self, observation: Observation) -> np.ndarray:
        """See LogitsPolicy.logits."""
        return self._run(self._read(observation))[0]


class OnnxRecurrentPolicy(TrainedPolicy, RecurrentScheduler):
    """Decides by a network with which every agent carries a memory; see TrainedPolicy and RecurrentScheduler."""

    def __init__(
        self, session: onnxruntime.InferenceSession, graph: GraphSpec, **options: Unpack[PolicyOptions]
    ) -> None:
        super().__init__(graph, **options)
        if self.mode == "one_pass":
            raise InvalidOptionError(f"mode of policy {self.name}: expected greedy or sample, as it has a memory")
        self._run = runner(session)
        self.memory_size = next(int(i.shape[1]) for i in session.get_inputs() if i.name == MEMORY)

    def decide(self, simulator: Any) -> np.ndarray:
        """See RecurrentScheduler; raises InvalidFileError for a simulator of another metagraph."""
        self._check(simulator)
        return super().decide(simulator)

    def choose_recurrent(
        self, observation: Observation, memory: np.ndarray, uniform: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Actions int64 (B,) and new memories float32 (B, memory_size); see RecurrentScheduler."""
        logits, after = self._run({**self._read(observation), MEMORY: memory})
        return self._pick(logits, uniform, observation), after


def load_onnx(
    path: str | Path, *, mode: Mode | None = None, graph: GraphSpec | None = None, pressing: Pressing | None = None
) -> OnnxPolicy | OnnxRecurrentPolicy:
    """A policy from its card and its NAME.onnx, by the path of any of its files.

    Raises InvalidFileError for a file that is missing, damaged or of other weights than the card's.
    """
    path = Path(path).with_suffix(".onnx")
    card_path = path.with_suffix(".json")
    card = read_card(card_path)
    if graph is not None:
        check_graph(card_path, card, graph)
    session = open_session(path, card)
    has_memory = any(one.name == MEMORY for one in session.get_inputs())
    kind = OnnxRecurrentPolicy if has_memory else OnnxPolicy
    chosen = card.mode if mode is None else mode
    return kind(session, card.graph, name=path.stem, mode=chosen, card=card, pressing=pressing)


def open_session(path: Path, card: PolicyCard) -> onnxruntime.InferenceSession:
    """Onnxruntime on one thread, without an arena of memory kept for later; raises as `load_onnx`."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.enable_cpu_mem_arena = False
    options.log_severity_level = _ERRORS_ONLY
    try:
        content = path.read_bytes()
    except OSError as error:
        expected = f"a readable file ({error.strerror}); `marl-sched export-onnx {path.with_suffix('.json')}` writes it"
        raise InvalidFileError(path, "", expected) from error
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own errors share no base class
        raise InvalidFileError(path, "", f"a whole ONNX file ({str(error)[:200]})") from error
    found = session.get_modelmeta().custom_metadata_map.get(WEIGHTS, "")
    if found != card.weights_sha256:
        raise InvalidFileError(path, WEIGHTS, f"the weights of its card (SHA-256 {card.weights_sha256})", found)
    return session


def runner(session: onnxruntime.InferenceSession) -> Run:
    """What runs a session on batches of any size, in blocks of BLOCK rows."""
    names = [one.name for one in session.get_inputs()]

    def run(arrays: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        rows = len(arrays[ACTION_MASK])
        if rows <= BLOCK:
            return session.run(None, {name: arrays[name] for name in names})
        blocks = [
            session.run(None, {name: arrays[name][first : first + BLOCK] for name in names})
            for first in range(0, rows, BLOCK)
        ]
        return [np.concatenate(parts) for parts in zip(*blocks, strict=True)]

    return run
