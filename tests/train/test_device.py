"""Where networks learn. Without a GPU here, against one that is pretended; see tests/train/pretended.py."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from marl_sched.errors import InvalidOptionError
from marl_sched.files import read_json, write_json
from marl_sched.train.config import RunRecord, load_config, load_record
from marl_sched.train.device import pick_device
from marl_sched.train.learner import Learner
from marl_sched.train.logging import RunLog
from marl_sched.train.parts import Parts, build
from marl_sched.train.run import resume, train_from_overrides
from tests.train.pretended import OnGpu, pretended_gpu

FAST = {"gae with a central critic", "imitation", "deeprm"}  # what the others share with these is much


class StoppedError(Exception):
    """Something from outside ends the run."""


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


def ended(directory: Path) -> tuple[dict[str, np.ndarray], list[dict[str, str]], bytes]:
    """What a run leaves: everything learned, its log but for the wall time, its best policy."""
    tensors = load_file(directory / read_json(directory / "checkpoint.json")["tensors"])
    with (directory / "progress.csv").open(newline="") as file:
        rows = [{name: value for name, value in row.items() if name != "seconds"} for row in csv.DictReader(file)]
    return {k: v.numpy() for k, v in tensors.items()}, rows, (directory / "policy.safetensors").read_bytes()


def assert_ended_alike(one: Path, other: Path) -> None:
    (tensors, rows, policy), (found, found_rows, found_policy) = ended(one), ended(other)
    assert tensors.keys() == found.keys()
    for name, tensor in tensors.items():
        assert np.array_equal(tensor, found[name]), name
    assert rows == found_rows
    assert policy == found_policy


def cases() -> list[Any]:
    return [
        pytest.param(overrides, id=name, marks=[] if name in FAST else pytest.mark.slow)
        for name, overrides in ALGORITHMS.items()
    ]


@pytest.mark.parametrize("overrides", cases())
def test_networks_and_optimiser_alone_are_on_the_gpu_and_learn_the_same(
    overrides: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """And a run that stopped on the GPU goes on there, with what the checkpoint keeps on the CPU."""
    on_cpu = train_from_overrides([*overrides, "device=cpu", f"run_dir={tmp_path / 'cpu'}"], quiet=True)
    learners: list[Learner] = []
    update = RunLog.update

    def interrupted(log: RunLog, values: dict[str, float]) -> None:
        update(log, values)
        if values["update"] == 2 and len(learners) == 1:
            raise StoppedError

    def watched(record: RunRecord) -> Parts:
        parts = build(record)
        learners.append(parts.learner)
        return parts

    monkeypatch.setattr(RunLog, "update", interrupted)
    monkeypatch.setattr("marl_sched.train.run.build", watched)
    on_gpu = tmp_path / "gpu"
    with pretended_gpu(monkeypatch) as gpu:
        monkeypatch.setattr("marl_sched.train.parts.pick_device", lambda name: gpu)
        with pytest.raises(StoppedError):
            train_from_overrides([*overrides, f"run_dir={on_gpu}"], quiet=True)
        resume(on_gpu, quiet=True)
        assert len(learners) == 2
        for learner in learners:
            learned = [parameter for module in learner.modules.values() for parameter in module.parameters()]
            learned += [value for state in learner.optimizer.state.values() for value in state.values()]
            assert len(learned) >= 4 * len(list(learner.policy.parameters()))
            assert all(tensor.device == gpu for tensor in learned)
    assert_ended_alike(on_cpu, on_gpu)


def test_the_pretended_gpu_refuses_what_a_real_one_would(monkeypatch: pytest.MonkeyPatch):
    with pretended_gpu(monkeypatch) as gpu:
        here, there = torch.ones(2, 3), torch.ones(2, 3).to(gpu)
        layer = torch.nn.Linear(3, 1).to(gpu)
        for mixed in (
            lambda: layer(here),
            lambda: there + here,
            lambda: torch.where(there > 0, there, here),
            lambda: torch.stack([there.sum(), here.sum()]),
            lambda: there[torch.tensor([0])],
        ):
            with pytest.raises(RuntimeError, match="same device"):
                mixed()
        with pytest.raises(RuntimeError, match="numpy"):
            there.numpy()
        assert torch.equal((there + 1).cpu(), here + 1)
        assert isinstance(torch.arange(3, device=gpu), OnGpu)


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


def test_a_record_from_before_there_was_a_choice_learns_wherever_it_can(tmp_path: Path):
    record = msgspec.to_builtins(RunRecord(config=load_config(["device=cpu"]), overrides=[], revision=""))
    del record["config"]["device"]
    write_json(tmp_path / "config.json", record)
    assert load_record(tmp_path / "config.json").config.device == "auto"


def test_a_run_tells_once_where_its_networks_learn(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    train_from_overrides([*HETGAT, *SEGMENTS, "device=cpu", f"run_dir={tmp_path / 'run'}"])
    assert capsys.readouterr().err.count("training on cpu") == 1
