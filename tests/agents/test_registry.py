"""Schedulers by name and by path."""

from __future__ import annotations

import subprocess
import sys

import msgspec
import pytest
import torch

from marl_sched.agents import create_scheduler, load_policy, registry, scheduler_names
from marl_sched.agents.networks.hetgat.network import HetGATNetwork
from marl_sched.agents.policies.cards import PolicyCard
from marl_sched.agents.policies.checkpoint import save_network
from marl_sched.agents.policies.network_policy import NetworkPolicy
from marl_sched.envs.airme.features import graph_spec
from marl_sched.errors import InvalidFileError, InvalidOptionError, UnknownNameError

RULES = ["random", "corrective", "corrective-published", "condition", "periodic", "model-based", "preventive-first"]


@pytest.fixture
def checkpoint(tmp_path):
    torch.manual_seed(0)
    network = HetGATNetwork(graph_spec(2))
    card = PolicyCard(
        domain="airme",
        objective="profit",
        view={"kind": "full"},
        graph=network.spec,
        sizes=network.sizes,
        command="marl-sched train",
        git_hash="",
        seed=0,
        scores={},
    )
    path = tmp_path / "mine.safetensors"
    save_network(path, network, card)
    return path, network, card


@pytest.fixture
def shipped(checkpoint, monkeypatch):
    """A package that ships one policy, `mine`."""
    monkeypatch.setattr(registry, "SHIPPED", checkpoint[0].parent)
    registry.shipped_policies.cache_clear()
    yield
    registry.shipped_policies.cache_clear()


def test_every_rule_of_airme_is_found_by_its_name():
    assert set(RULES) <= set(scheduler_names("airme"))
    for name in RULES:
        assert create_scheduler(name, "airme").name == name


def test_a_rule_takes_its_own_options_and_no_others():
    assert create_scheduler("preventive-first", "airme", hours=30.0).name == "preventive-first"
    with pytest.raises(TypeError, match="hourss"):
        create_scheduler("preventive-first", "airme", hourss=30.0)


def test_an_unknown_scheduler_gets_a_suggestion_and_the_known_names():
    with pytest.raises(UnknownNameError, match=r"unknown scheduler 'corectiv'; did you mean 'corrective'.*periodic"):
        create_scheduler("corectiv", "airme")


def test_a_shipped_policy_is_found_by_its_name_in_its_own_domain_only(shipped):
    assert scheduler_names("airme")[-1] == "mine"
    assert "mine" not in scheduler_names("murse")
    policy = create_scheduler("mine", "airme", mode="sample")
    assert isinstance(policy, NetworkPolicy)
    assert (policy.name, policy.mode) == ("mine", "sample")
    assert load_policy("mine").card == policy.card
    with pytest.raises(InvalidOptionError, match="scheduler mine: is one of airme, expected one of murse"):
        create_scheduler("mine", "murse")


def test_a_checkpoint_is_found_by_its_path(checkpoint):
    path, network, _ = checkpoint
    for given in (path, str(path), path.with_suffix(".json")):
        assert create_scheduler(given, "airme").graph == network.spec


def test_a_checkpoint_of_another_domain_is_refused(checkpoint):
    path, network, card = checkpoint
    save_network(path, network, msgspec.structs.replace(card, domain="murse"))
    with pytest.raises(InvalidFileError, match=r"domain: expected a policy for airme, got 'murse'"):
        create_scheduler(path, "airme")


def test_a_path_without_a_file_is_named():
    with pytest.raises(InvalidFileError, match=r"nowhere.*: expected a readable file"):
        create_scheduler("nowhere/policy.safetensors", "airme")


def test_an_unknown_policy_name_and_mode_are_refused(checkpoint):
    with pytest.raises(UnknownNameError, match="unknown policy 'airme-nothing'"):
        load_policy("airme-nothing")
    with pytest.raises(InvalidOptionError, match="expected one of greedy, sample"):
        load_policy(checkpoint[0], mode="warm")


def test_listing_and_rules_need_no_torch():
    code = (
        "import sys; from marl_sched.agents import create_scheduler, scheduler_names;"
        "create_scheduler(scheduler_names('airme')[0], 'airme'); sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_rule_asked_for_as_a_trained_policy_is_named_with_what_makes_it():
    with pytest.raises(InvalidOptionError, match=r"rule of airme: .*create_scheduler\('preventive-first', 'airme'\)"):
        load_policy("preventive-first")


@pytest.mark.parametrize(
    ("name", "owner", "domain"), [("edf", "murse", "airme"), ("airme-full-profit", "airme", "murse")]
)
def test_another_domains_scheduler_is_named_as_such(name, owner, domain):
    with pytest.raises(InvalidOptionError, match=f"scheduler {name}: is one of {owner}, expected one of {domain}: "):
        create_scheduler(name, domain)
