"""Policies as files: what is written is what is read, and nothing else is."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from marl_sched.agents.networks.hetgat.network import HetGATNetwork
from marl_sched.agents.policies import cards
from marl_sched.agents.policies.cards import PolicyCard, check_graph, read_card, source_revision
from marl_sched.agents.policies.checkpoint import load_network, save_network
from marl_sched.agents.policies.network_policy import NetworkPolicy
from marl_sched.agents.registry import create_scheduler
from marl_sched.domain import domain_names, get_domain
from marl_sched.errors import InvalidFileError
from marl_sched.graph import NodeType


@pytest.fixture
def network(graph) -> HetGATNetwork:
    torch.manual_seed(0)
    return HetGATNetwork(graph, width=3, heads=2, layers=2)


def card_of(network: HetGATNetwork) -> PolicyCard:
    return PolicyCard(
        domain="airme",
        objective="profit",
        view={"kind": "local", "reach": 1, "comm": 1, "staleness": 0},
        graph=network.spec,
        sizes=network.sizes,
        command="marl-sched train env=airme view=local seed=7",
        git_hash=source_revision(),
        seed=7,
        scores={"small": {"M1": 0.69, "instances": 100, "episodes": 10}},
    )


@pytest.fixture
def saved(network, tmp_path) -> Path:
    path = tmp_path / "mine.safetensors"
    save_network(path, network, card_of(network))
    return path


def test_a_checkpoint_comes_back_as_it_was(network, saved, sizes, observe):
    observation = observe(network.spec, sizes)
    for path in (saved, saved.with_suffix(".json")):
        again, card = load_network(path)
        assert torch.equal(again(observation), network(observation))
        assert msgspec.structs.replace(card, weights_sha256="") == card_of(network)
        assert again.spec == network.spec
    policy = NetworkPolicy.load(saved, graph=network.spec)
    assert policy.name == "mine"
    assert policy.choose({name: v.numpy() for name, v in observation.items()}, np.zeros(3)).shape == (3,)


def test_a_card_from_before_there_were_other_architectures_is_hetgats(network, saved):
    card = saved.with_suffix(".json")
    content = json.loads(card.read_text())
    assert content["sizes"].pop("architecture") == "hetgat"
    card.write_text(json.dumps(content))
    assert read_card(card).sizes == network.sizes


def test_saving_leaves_two_files_and_no_temporary_one(saved):
    assert sorted(path.name for path in saved.parent.iterdir()) == ["mine.json", "mine.safetensors"]


@pytest.mark.parametrize("kept", [0, 7, 100, -1])
def test_a_truncated_weights_file_is_refused(saved, kept: int):
    saved.write_bytes(saved.read_bytes()[:kept])
    with pytest.raises(InvalidFileError, match=r"mine\.safetensors: expected a whole safetensors file"):
        load_network(saved)


def test_a_truncated_card_is_refused(saved):
    card = saved.with_suffix(".json")
    card.write_bytes(card.read_bytes()[:200])
    with pytest.raises(InvalidFileError, match=r"mine\.json: line \d+ column \d+: expected valid JSON"):
        load_network(saved)


def test_a_missing_file_is_named(saved):
    saved.unlink()
    with pytest.raises(InvalidFileError, match=r"mine\.safetensors: expected a readable file \(No such file"):
        load_network(saved)


def test_weights_of_another_card_are_refused(network, saved):
    other = saved.with_name("other.safetensors")
    with torch.no_grad():
        network.readout.bias.add_(1)
    save_network(other, network, card_of(network))
    other.replace(saved)
    with pytest.raises(InvalidFileError, match="expected the weights of its card"):
        load_network(saved)


def test_a_pickle_is_not_loaded(saved, tmp_path):
    marker = tmp_path / "executed"

    class Malice:
        def __reduce__(self):
            return Path.touch, (marker,)

    torch.save({"weights": Malice()}, saved)
    with pytest.raises(InvalidFileError, match="expected a whole safetensors file"):
        load_network(saved)
    assert not marker.exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": 2}, r"mine\.json: \.?schema: expected a policy card of schema 1 \(Invalid enum value 2"),
        ({"sizes": {"width": 0, "heads": 2, "layers": 2}}, r"sizes\.width: .*`int` >= 1"),
        ({"colour": "red"}, r"contains unknown field `colour`"),
        ({"seed": "seven"}, r"seed: .*Expected `int`, got `str`"),
    ],
)
def test_a_malformed_card_names_the_field(saved, change, message: str):
    card = saved.with_suffix(".json")
    card.write_text(json.dumps({**json.loads(card.read_text()), **change}))
    with pytest.raises(InvalidFileError, match=message):
        load_network(saved)


def decide_on_nothing(card):
    card["graph"]["decision_of"] = "xx"


def no_nodes(card):
    card["graph"]["nodes"] = []


def unknown_source(card):
    card["graph"]["relations"][0]["source"] = "xx"


def unknown_target(card):
    card["graph"]["relations"][-1]["target"] = "xx"


def same_node_twice(card):
    card["graph"]["nodes"].append(card["graph"]["nodes"][0])


def same_relation_twice(card):
    card["graph"]["relations"].append(card["graph"]["relations"][0])


def no_features(card):
    card["graph"]["nodes"][0]["features"] = []


def name_with_a_dot(card):
    card["graph"]["nodes"][0]["name"] = "a.b"


def scatter_without_index(card):
    card["graph"]["relations"][0] |= {"pattern": "scatter", "index": None}


def enormous(card):
    card["sizes"]["width"] = 10**9


def no_view(card):
    card["view"] = {}


@pytest.mark.parametrize(
    ("damage", "field"),
    [
        (decide_on_nothing, r"graph\.decision_of: expected one of .*got 'xx'"),
        (no_nodes, r"graph\.nodes: expected at least one"),
        (unknown_source, r"graph\.relations\[0\]\.source: .*got 'xx'"),
        (unknown_target, r"graph\.relations\[\d+\]\.target: .*got 'xx'"),
        (same_node_twice, r"graph\.nodes: expected distinct names"),
        (same_relation_twice, r"graph\.relations: expected distinct names"),
        (no_features, r"graph\.nodes\[0\]\.features: expected at least one"),
        (name_with_a_dot, r"graph\.nodes\[0\]\.name: .*got 'a\.b'"),
        (scatter_without_index, r"graph\.relations\[0\]\.index: expected an index array"),
        (enormous, r"sizes\.width: "),
        (no_view, r"view\.kind: expected the name of a view"),
    ],
)
def test_a_card_that_contradicts_itself_is_refused_by_file_and_field(saved, damage, field: str):
    card = saved.with_suffix(".json")
    content = json.loads(card.read_text())
    damage(content)
    card.write_text(json.dumps(content))
    with pytest.raises(InvalidFileError, match=r"mine\.json: " + field):
        load_network(saved)


def test_the_largest_sizes_are_compared_with_the_weights_before_memory_is_asked_for(saved):
    card = saved.with_suffix(".json")
    content = json.loads(card.read_text())
    content["sizes"] = {"width": 1024, "heads": 64, "layers": 32}  # would take terabytes
    card.write_text(json.dumps(content))
    with pytest.raises(InvalidFileError, match=r"mine\.safetensors: .*expected torch.float32 of shape"):
        load_network(saved)


@pytest.mark.parametrize("domain", domain_names())
def test_the_graph_of_every_domain_makes_a_card_that_is_read(domain: str, tmp_path):
    known = get_domain(domain)
    spec = known.simulator(known.instances(next(iter(known.scales)), 1, 0)).graph
    network = HetGATNetwork(spec, width=2, heads=1, layers=1)
    save_network(tmp_path / "mine.safetensors", network, card_of(network))
    assert load_network(tmp_path / "mine.json")[1].graph == spec


def test_a_card_of_other_sizes_than_the_weights_names_the_tensor(saved):
    card = saved.with_suffix(".json")
    content = json.loads(card.read_text())
    content["sizes"]["width"] = 4
    card.write_text(json.dumps(content))
    with pytest.raises(InvalidFileError, match=r"expected torch.float32 of shape .*, got 'torch.float32 of shape"):
        load_network(saved)


def test_a_policy_for_other_features_is_refused_by_name(network, saved):
    first = network.spec.nodes[0]
    renamed = replace(
        network.spec, nodes=(NodeType(first.name, ("rust", *first.features[1:])), *network.spec.nodes[1:])
    )
    with pytest.raises(InvalidFileError, match=rf"features of '{first.name}': .*lacks \['rust'\]"):
        NetworkPolicy.load(saved, graph=renamed)


def test_a_policy_for_other_relations_is_refused(network, saved):
    fewer = replace(network.spec, relations=network.spec.relations[1:])
    with pytest.raises(InvalidFileError, match="relations: expected those of the environment's graph"):
        NetworkPolicy.load(saved, graph=fewer)
    check_graph(saved, read_card(saved.with_suffix(".json")), network.spec)


def test_a_policy_of_another_domain_is_refused_by_its_card(saved):
    for path in (saved, saved.with_suffix(".json")):
        with pytest.raises(InvalidFileError, match=r"mine\.json: domain: expected a policy for murse, got 'airme'"):
            create_scheduler(path, "murse")
    murse = get_domain("murse")
    simulator = murse.simulator(murse.instances("small", 1, 0))
    with pytest.raises(InvalidFileError, match=r"^mine\.json: "):
        NetworkPolicy.load(saved).decide(simulator)


def test_a_package_inside_somebody_elses_checkout_has_no_revision(tmp_path, monkeypatch):
    for command in (
        ["init", "-q"],
        ["-c", "user.name=a", "-c", "user.email=a", "commit", "-q", "--allow-empty", "-m", "x"],
    ):
        subprocess.run(["git", "-C", str(tmp_path), *command], check=True)
    installed = tmp_path / "site-packages" / "cards.py"
    installed.parent.mkdir()
    installed.touch()
    monkeypatch.setattr(cards, "__file__", str(installed))
    assert source_revision() == ""
    subprocess.run(["git", "-C", str(tmp_path), "add", "--", str(installed)], check=True)
    assert len(source_revision().removesuffix("-dirty")) == 40


def test_loading_draws_nothing_and_does_without_the_compiler_of_torch(saved):
    script = (
        "import sys, torch; from marl_sched.agents.policies.checkpoint import load_network\n"
        f"before = torch.get_rng_state(); load_network({str(saved)!r})\n"
        "print(torch.equal(before, torch.get_rng_state()), 'torch._dynamo' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False"]
