"""What carries a version says which there are, and old files are still read."""

import subprocess
import sys
from pathlib import Path

import pettingzoo
import pytest

import marl_sched
from marl_sched.domain import get_domain


def test_an_environment_of_a_version_that_is_not_there_is_answered_with_those_that_are() -> None:
    with pytest.raises(AttributeError, match=r"no airme_v7; the versions of this environment are airme_v0"):
        _ = marl_sched.airme_v7


def test_other_names_are_unknown_as_usual() -> None:
    with pytest.raises(AttributeError, match="no attribute 'airme'"):
        _ = marl_sched.airme


@pytest.mark.parametrize(
    "order", ["import pettingzoo, marl_sched", "from marl_sched import airme_v0; import pettingzoo"]
)
def test_pettingzoos_registry_makes_the_environments(order: str) -> None:
    if not hasattr(pettingzoo, "make"):
        pytest.skip("this PettingZoo has no registry")
    code = (
        f"{order}\n"
        "for kind in ('aec', 'parallel'):\n"
        "    env = pettingzoo.make(kind, 'marl_sched/AirME-v0', horizon=3)\n"
        "    env.reset(seed=1)\n"
        "    print(len(env.agents))\n"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert len(set(done.stdout.split())) == 1


# Written by version 0.1.0, which computed these identities; an instance's noise depends on its identity.
IDENTITIES = {"airme": 7762016299466705271, "murse": 17004606292067971181}


@pytest.mark.parametrize("domain", sorted(IDENTITIES))
def test_an_instance_file_of_version_0_1_0_is_read_as_the_same_instance(domain: str) -> None:
    path = Path(__file__).parent / "files" / f"{domain}-0.1.0.json"
    assert get_domain(domain).load(path).identity == IDENTITIES[domain]
