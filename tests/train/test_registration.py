from __future__ import annotations

from importlib.resources import files

import msgspec
import pytest
import yaml

from marl_sched.agents.networks.registry import networks
from marl_sched.errors import InvalidOptionError
from marl_sched.train.algorithms.base import algorithms
from marl_sched.train.config import load_config

CONFIGS = files("marl_sched.configs")
POLICY_FILES = {"hetgat": "default"}  # the network of `policy=default`; the others have files of their own names


@pytest.mark.parametrize("name", sorted(networks()))
def test_a_networks_struct_is_its_yaml(name: str):
    content = yaml.safe_load(CONFIGS.joinpath("policy", f"{POLICY_FILES.get(name, name)}.yaml").read_text())
    assert content["name"] == name
    assert content.keys() == {"name", *networks()[name].__struct_fields__}


@pytest.mark.parametrize("name", sorted(algorithms()))
def test_an_algorithms_struct_is_its_yaml_and_has_no_defaults_of_its_own(name: str):
    config = load_config([f"algorithm={name}"]).algorithm
    assert type(config) is algorithms()[name]
    content = yaml.safe_load(CONFIGS.joinpath("algorithm", f"{name}.yaml").read_text())
    assert (content.keys() - {"defaults"}) | ({"ppo"} if "defaults" in content else set()) == {
        "name",
        *type(config).__struct_fields__,
    }
    assert type(config).__struct_defaults__ == ()


def test_an_unknown_algorithm_or_network_is_refused_with_those_that_are_known():
    with pytest.raises(InvalidOptionError, match=r"unknown network 'lenet'.*Known: decima"):
        load_config(["policy.name=lenet"])
    with pytest.raises(InvalidOptionError, match=r"unknown algorithm 'trpo'.*Known: .*gae"):
        load_config(["algorithm.name=trpo"])


def test_a_bad_size_is_named_with_its_place():
    with pytest.raises(InvalidOptionError, match=r"Expected `int` >= 1.*\$\.policy\.width"):
        load_config(["policy.width=0"])


def test_sizes_come_back_from_a_card():
    from marl_sched.agents.networks.registry import config_of_card

    config = load_config(["policy=decima"]).policy
    assert config.as_card() == {"architecture": "decima", "hidden": 64, "layers": 3}
    assert config_of_card(msgspec.to_builtins(config.as_card())) == config
