"""What onnxruntime decides by a policy's ONNX file is what PyTorch decides by its weights."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from marl_sched.agents.registry import create_scheduler, load_policy, policy_path, shipped_policies
from marl_sched.errors import InvalidFileError, UnknownNameError
from marl_sched.problem import Problem

pytest.importorskip("torch")
onnxruntime = pytest.importorskip("onnxruntime", reason="the extra [light] is not installed")

TIE = 1e-5
WITH_ONNX = [name for name in shipped_policies() if policy_path(name).with_suffix(".onnx").exists()]


def met(problem: Problem, turns: int):
    """What the acting agents of a batch see, turn by turn, while a policy that samples plays."""
    simulator = problem.simulator()
    simulator.reset(seed=problem.seed, episodes=problem.episode_numbers(list(range(problem.count))))
    rng = np.random.default_rng(0)
    for _ in range(turns):
        rows, observation = simulator.observe_acting()
        if not len(rows):
            return
        yield {name: values.copy() for name, values in observation.items()}
        legal = simulator.legal()
        actions = np.array([rng.choice(np.flatnonzero(row)) if row.any() else 0 for row in legal])
        simulator.step(actions)


def test_every_shipped_onnx_file_is_of_its_cards_weights():
    assert "airme-local-profit" in WITH_ONNX
    for name in WITH_ONNX:
        assert load_policy(name, runtime="onnx").graph == shipped_policies()[name].graph


@pytest.mark.parametrize(
    ("name", "envs", "turns"), [("airme-local-profit", 200, 50), ("murse-local-makespan", 100, 10)], ids=str
)
def test_onnxruntime_decides_as_torch_does_but_for_ties(name, envs, turns):
    """10 000 observations of AirME, 1 000 of MuRSE. Logits of float32 networks agree within 1e-5 of their size."""
    card = shipped_policies()[name]
    by_torch, by_onnx = load_policy(name), load_policy(name, runtime="onnx")
    problem = Problem(card.domain, count=envs, seed=5, view=card.view)
    seen = 0
    for observation in met(problem, turns):
        expected, logits = by_torch.logits(observation), by_onnx.logits(observation)
        legal = observation["action_mask"] > 0
        scale = np.maximum(np.abs(np.where(legal, expected, 0)).max(1, keepdims=True), 1)
        assert (np.abs(np.where(legal, logits - expected, 0)) <= TIE * scale).all()
        uniform = np.zeros(len(legal))
        differ = np.flatnonzero(by_torch.choose(observation, uniform) != by_onnx.choose(observation, uniform))
        best = np.sort(np.where(legal, expected, -np.inf), axis=1)
        assert (best[differ, -1] - best[differ, -2] < TIE * scale[differ, 0]).all()
        seen += len(legal)
    assert seen >= envs * turns * 0.9


def test_a_runtime_can_be_chosen_by_name_where_schedulers_are():
    policy = create_scheduler("airme-local-profit", "airme", runtime="onnx", mode="sample")
    assert (policy.name, policy.samples) == ("airme-local-profit", True)
    with pytest.raises(UnknownNameError, match=r"runtime 'tensorrt'.*onnx, torch"):
        load_policy("airme-local-profit", runtime="tensorrt")


def test_an_onnx_file_of_other_weights_is_refused_and_a_missing_one_named(tmp_path: Path):
    for suffix in (".json", ".safetensors"):
        shutil.copy(policy_path("airme-full-profit").with_suffix(suffix), tmp_path / f"mine{suffix}")
    with pytest.raises(InvalidFileError, match="export-onnx"):
        load_policy(tmp_path / "mine.json", runtime="onnx")
    shutil.copy(policy_path("airme-local-profit").with_suffix(".onnx"), tmp_path / "mine.onnx")
    with pytest.raises(InvalidFileError, match="weights of its card"):
        load_policy(tmp_path / "mine.json", runtime="onnx")
    (tmp_path / "mine.onnx").write_bytes(b"no model")
    with pytest.raises(InvalidFileError, match="whole ONNX file"):
        load_policy(tmp_path / "mine.json", runtime="onnx")


@pytest.mark.slow
def test_an_exported_network_with_a_memory_decides_as_it_does_in_torch(tmp_path: Path):
    """Of any size: the export is followed with other numbers of rows and planes than these observations have."""
    pytest.importorskip("onnxscript", reason="the extra [onnx-export] is not installed")
    import torch

    from marl_sched.agents.networks.lstm import LstmConfig
    from marl_sched.agents.policies.cards import PolicyCard
    from marl_sched.agents.policies.checkpoint import save_network
    from marl_sched.agents.policies.onnx_export import export_onnx

    problem = Problem("airme", count=4, seed=2)
    graph = problem.simulator().graph
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = LstmConfig(hidden=8, layers=2, units=4).build(graph)
    card = PolicyCard(
        domain="airme", objective="profit", view={"kind": "full"}, graph=graph, sizes=network.sizes, command="none",
        git_hash="none", seed=0, scores={}, mode="sample",
    )  # fmt: skip
    save_network(tmp_path / "mine.safetensors", network, card)
    export_onnx(tmp_path / "mine.json", tmp_path / "mine.onnx")
    by_torch, by_onnx = load_policy(tmp_path / "mine.json"), load_policy(tmp_path / "mine.json", runtime="onnx")
    assert by_onnx.memory_size == by_torch.memory_size > 0
    kept = remembered = by_torch.initial_memory(4)
    for observation in met(problem, 5):
        expected, kept = by_torch.choose_recurrent(observation, kept, np.full(4, 0.4))
        action, remembered = by_onnx.choose_recurrent(observation, remembered, np.full(4, 0.4))
        np.testing.assert_allclose(remembered, kept, atol=TIE, rtol=TIE)
        assert (action == expected).all()
