"""Where networks learn: on the CPU everywhere, and on a GPU where there is one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from marl_sched.errors import InvalidOptionError
from marl_sched.files import read_json, write_json
from marl_sched.train.config import load_config, load_record
from marl_sched.train.device import pick_device
from marl_sched.train.parts import build
from marl_sched.train.run import resume, train_from_overrides

FAST = {"gae with a central critic", "imitation", "deeprm"}  # what the others share with these is much


TINY = [
    "updates=2", "curriculum.start=10", "curriculum.stop=12", "curriculum.step=1", "save_every=1", "validation.every=2",
    "validation.instances=1", "validation.length=10",
]  # fmt: skip
HETGAT = [*TINY, "policy.width=2", "policy.heads=2", "policy.layers=2"]
SEGMENTS = ["algorithm.instances=4", "algorithm.turns=12"]
EPISODES = ["algorithm.instances=2", "algorithm.episodes=2"]
ALGORITHMS = {
    "gae": [*HETGAT, *SEGMENTS, "algorithm.critic.width=2", "algorithm.ppo.minibatch=32"],
    "gae with a central critic": [*HETGAT, *SEGMENTS, "algorithm.critic.width=2", "view=local"],
    "ippo": ["algorithm=ippo", *HETGAT, *SEGMENTS, "algorithm.critic.width=2", "view=local"],
    "step baseline": ["algorithm=step_baseline", *HETGAT, *EPISODES],
    "state value": ["algorithm=state_value", *HETGAT, *EPISODES, "algorithm.critic.width=2"],
    "imitation": ["algorithm=imitation", *HETGAT, *SEGMENTS, "algorithm.minibatch=32", "view=local"],
    "expected advantage": ["algorithm=imitation", *HETGAT, *SEGMENTS, "algorithm.criterion=expected_advantage"],
    "decima": ["algorithm=reinforce", "policy=decima", *TINY, *EPISODES, "policy.hidden=4"],
    "deeprm": ["algorithm=reinforce", "policy=deeprm", *TINY, *EPISODES, "policy.hidden=4"],
}


def cases() -> list[Any]:
    return [
        pytest.param(overrides, id=name, marks=[] if name in FAST else pytest.mark.slow)
        for name, overrides in ALGORITHMS.items()
    ]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device here")
@pytest.mark.parametrize("overrides", cases())
def test_a_run_learns_on_the_gpu_stops_and_goes_on_there(overrides: list[str], tmp_path: Path):
    """Everything learned is on the GPU, what the checkpoint keeps is on the CPU."""
    run = [*overrides, "device=cuda", f"run_dir={tmp_path}"]
    train_from_overrides([*run, "updates=1"], quiet=True)
    record = read_json(tmp_path / "config.json")
    record["config"]["updates"] = 2
    write_json(tmp_path / "config.json", record)
    resume(tmp_path, quiet=True)
    parts = build(load_record(tmp_path / "config.json"))
    assert parts.restore(tmp_path).update == 2
    learner = parts.learner
    learned = [parameter for module in learner.modules.values() for parameter in module.parameters()]
    learned += [value for state in learner.optimizer.state.values() for value in state.values()]
    assert len(learned) >= 4 * len(list(learner.policy.parameters()))
    assert all(tensor.device.type == "cuda" for tensor in learned)


def test_auto_is_a_gpu_exactly_where_there_is_one():
    assert pick_device("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")
    assert pick_device("cpu").type == "cpu"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_asking_for_a_gpu_where_there_is_none_is_refused_before_anything_is_written(tmp_path: Path):
    with pytest.raises(InvalidOptionError, match=r"device: expected auto or cpu, got cuda, and torch sees no CUDA"):
        train_from_overrides([*HETGAT, "device=cuda", f"run_dir={tmp_path / 'run'}"], quiet=True)
    assert not (tmp_path / "run").exists()


def test_a_device_that_is_none_is_refused():
    with pytest.raises(InvalidOptionError, match=r"device"):
        load_config(["device=abacus"])


def test_a_run_tells_once_where_its_networks_learn(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    train_from_overrides([*HETGAT, *SEGMENTS, "device=cpu", f"run_dir={tmp_path / 'run'}"])
    assert capsys.readouterr().err.count("training on cpu") == 1
