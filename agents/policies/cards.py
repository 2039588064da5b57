"""The card of a trained policy: what it decides, on what it was trained, and how well it did.

A card is the JSON file beside the weights. It holds the metagraph that the network was built for, so a
policy can be rebuilt without its domain, and is refused where a domain's graph has become another.
"""

from __future__ import annotations

import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from marl_sched.errors import InvalidFileError
from marl_sched.files import read_json, write_json
from marl_sched.graph import DECISION, STATE, GraphSpec, Relation

SCHEMA = 1
# Far beyond what a scheduler of a few hundred nodes can use; a damaged card shall not ask for terabytes.
Width = Annotated[int, Meta(ge=1, le=1024)]
Heads = Annotated[int, Meta(ge=1, le=64)]
Layers = Annotated[int, Meta(ge=1, le=32)]
Slots = Annotated[int, Meta(ge=1, le=65536)]
Mode = Literal["greedy", "sample", "one_pass"]  # see marl_sched.agents.policies.network_policy.TrainedPolicy
_ARCHITECTURE = "architecture"


class PolicyCard(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the weights beside it are.

    Attributes:
        domain: the environment's name.
        objective: the reward it was trained for.
        view: what an agent saw in training: `{"kind": "local", "reach": 1, ...}`.
        graph: node types with the names of their features, relations, and what is decided on.
        sizes: of the network, `{"architecture": NAME, ...}`; marl_sched.agents.networks.registry reads them.
        command: the exact command that trained it.
        git_hash: the source that the command ran on, see `source_revision`.
        seed: of the training run.
        scores: measured, for example `{"small": {"M1": 0.7, "instances": 100, "episodes": 10}}`.
        training_knowledge: what training used beyond the view, such as a critic on the full graph; the
            policy itself sees its view and nothing else.
        mode: how it decides unless told otherwise, and decided when the scores were measured.
        weights_sha256: of the safetensors file.
        schema: of this card.
    """

    domain: str
    objective: str
    view: dict[str, Any]
    graph: GraphSpec
    sizes: dict[str, Any]
    command: str
    git_hash: str
    seed: int
    scores: dict[str, Any]
    training_knowledge: str = ""
    mode: Mode = "greedy"
    weights_sha256: str = ""
    schema: Literal[1] = 1


def write_card(path: str | Path, card: PolicyCard) -> None:
    """Write a card as JSON, whole or not at all."""
    write_json(path, msgspec.to_builtins(card))


def read_card(path: str | Path) -> PolicyCard:
    """The card in a JSON file; InvalidFileError names the field that is not as expected.

    Cards that name no architecture are from when there was one.
    """
    content = read_json(path)
    match content:
        case {"sizes": dict() as sizes}:
            sizes.setdefault(_ARCHITECTURE, "hetgat")
    try:
        card = msgspec.convert(content, PolicyCard)
    except msgspec.ValidationError as error:
        reason, _, where = str(error).partition(" - at `$")
        field = where.strip("`.") or "card"
        raise InvalidFileError(path, field, f"a policy card of schema {SCHEMA} ({reason})") from error
    if not isinstance(card.view.get("kind"), str):
        raise InvalidFileError(path, "view.kind", "the name of a view", card.view.get("kind"))
    _check_names(path, card.graph)
    for i, relation in enumerate(card.graph.relations):
        _check_relation(path, f"graph.relations[{i}]", relation, [node.name for node in card.graph.nodes])
    keys = [relation.key for relation in card.graph.relations]
    _require_distinct(path, "graph.relations", keys)
    return card


def _check_names(path: str | Path, graph: GraphSpec) -> None:
    """Raise InvalidFileError unless nodes and features have distinct names and decisions are on one of the nodes."""
    names = [node.name for node in graph.nodes]
    if not names:
        raise InvalidFileError(path, "graph.nodes", "at least one node type", [])
    for i, name in enumerate(names):
        if not name.isidentifier() or name in (STATE, DECISION):
            expected = f"an identifier other than {STATE!r} and {DECISION!r}"
            raise InvalidFileError(path, f"graph.nodes[{i}].name", expected, name)
    _require_distinct(path, "graph.nodes", names)
    features = {f"graph.nodes[{i}].features": node.features for i, node in enumerate(graph.nodes)}
    for field, listed in {**features, "graph.state_features": graph.state_features}.items():
        if not listed:
            raise InvalidFileError(path, field, "at least one feature", [])
        _require_distinct(path, field, listed)
    if graph.decision_of not in names:
        raise InvalidFileError(path, "graph.decision_of", f"one of the node types {names}", graph.decision_of)


def _check_relation(path: str | Path, field: str, relation: Relation, nodes: list[str]) -> None:
    """Raise InvalidFileError unless both ends exist and what the pattern reads is named."""
    for end in ("source", "target"):
        if getattr(relation, end) not in (known := [*nodes, STATE, DECISION]):
            raise InvalidFileError(path, f"{field}.{end}", f"one of {known}", getattr(relation, end))
    if not relation.name.isidentifier():
        raise InvalidFileError(path, f"{field}.name", "an identifier", relation.name)
    if relation.pattern in ("scatter", "gather") and not relation.index:
        raise InvalidFileError(path, f"{field}.index", f"an index array for the pattern {relation.pattern!r}")


def _require_distinct(path: str | Path, field: str, names: Sequence[str]) -> None:
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise InvalidFileError(path, field, "distinct names", twice[0])


def check_graph(path: str | Path, card: PolicyCard, graph: GraphSpec) -> None:
    """Raise InvalidFileError, which says where they differ, unless a policy was trained on this metagraph."""
    if card.graph == graph:
        return
    ours, theirs = _features(card.graph), _features(graph)
    for name in ours | theirs:
        if ours.get(name) != theirs.get(name):
            _refuse(path, f"features of {name!r}", theirs.get(name), ours.get(name))
    _refuse(path, "relations", _relations(graph), _relations(card.graph))


def source_revision() -> str:
    """The git commit of the running source, with `-dirty` after it if files differ, or "" outside a checkout.

    A package that is installed inside somebody else's checkout is not of it.
    """
    here = Path(__file__).resolve()
    commands = (
        ["git", "-C", str(here.parent), "ls-files", "--error-unmatch", here.name],
        ["git", "-C", str(here.parent), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
    )
    try:
        found = [subprocess.run(command, capture_output=True, text=True, check=False) for command in commands]
    except FileNotFoundError:  # git itself is not installed
        return ""
    return found[1].stdout.strip() if all(done.returncode == 0 for done in found) else ""


def _features(graph: GraphSpec) -> dict[str, tuple[str, ...]]:
    return {**{node.name: node.features for node in graph.nodes}, STATE: graph.state_features}


def _relations(graph: GraphSpec) -> Mapping[str, Any]:
    described = msgspec.to_builtins(graph)
    return {"decision_of": described["decision_of"], "relations": described["relations"]}


def _refuse(path: str | Path, what: str, expected: Any, got: Any) -> None:
    """Name what only one side has; both sides in full would not fit a line."""
    if isinstance(expected, tuple) and isinstance(got, tuple):
        missing = [name for name in expected if name not in got]
        unknown = [name for name in got if name not in expected]
        detail = f"{len(expected)} features of the environment's graph (the policy lacks {missing}, knows {unknown})"
        raise InvalidFileError(path, what, detail, f"{len(got)}")
    raise InvalidFileError(path, what, "those of the environment's graph", got)
