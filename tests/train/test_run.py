from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from marl_sched.agents.policies.cards import read_card, source_revision
from marl_sched.agents.policies.network_policy import NetworkPolicy
from marl_sched.agents.registry import create_scheduler
from marl_sched.domain import get_domain
from marl_sched.errors import InvalidFileError, InvalidOptionError, MarlSchedError
from marl_sched.files import read_json, write_json
from marl_sched.train.callbacks import Callback, Run
from marl_sched.train.checkpoint import Counters
from marl_sched.train.collect import Rollout
from marl_sched.train.config import RunRecord, load_config, load_record
from marl_sched.train.evaluation.evaluate import evaluate_scheduler
from marl_sched.train.logging import RunLog
from marl_sched.train.parts import build
from marl_sched.train.run import resume, train, train_from_overrides
from marl_sched.train.validation import Validation

TINY = [
    "view=local", "policy.width=2", "policy.heads=2", "policy.layers=2", "algorithm.ppo.minibatch=64", "updates=4",
    "curriculum.start=10", "curriculum.stop=12", "curriculum.step=1", "save_every=2", "validation.every=2",
    "validation.instances=2", "validation.length=20",
]  # fmt: skip
GAE = [*TINY, "algorithm.instances=4", "algorithm.turns=12", "algorithm.critic.width=2"]
STEP_BASELINE = [*TINY, "algorithm=step_baseline", "algorithm.instances=2", "algorithm.episodes=2"]
IPPO = ["algorithm=ippo", *GAE]
STATE_VALUE = ["algorithm=state_value", *TINY, "algorithm.instances=2", "algorithm.critic.width=2"]
RANDOM_VIEW = [*GAE, "view=random", "view.staleness_most=3"]
IMITATION = [
    "algorithm=imitation", *(word for word in TINY if ".ppo." not in word), "algorithm.instances=4",
    "algorithm.turns=12", "algorithm.minibatch=16",
]  # fmt: skip
ROLLOUT_IMITATION = [
    "env=murse", "policy=hetgat_residual", "algorithm=rollout_imitation", "curriculum=rounds", "env.scales=[small]",
    "policy.width=2", "policy.heads=2", "policy.hidden=4", "algorithm.instances=4", "algorithm.turns=12",
    "algorithm.minibatch=16", "updates=4", "save_every=2", "validation.every=2", "validation.instances=2",
    "validation.length=1",
]  # fmt: skip

GREEDY_ROLLOUT = [
    "env=murse", "policy=hybridnet", "algorithm=greedy_rollout", "curriculum=rounds", "env.scales=[small]",
    "policy.width=2", "policy.heads=2", "policy.hidden=4", "policy.edge_width=2", "algorithm.instances=3",
    "algorithm.samples=3", "algorithm.rounds=2", "algorithm.renew=2", "algorithm.imitation=0.1",
    "algorithm.teacher=lst-search", "algorithm.teacher_share=0.5", "+env.options.durations=stochastic", "device=cpu",
    "updates=4", "save_every=2", "validation.every=2", "validation.instances=2", "validation.length=1",
]  # fmt: skip

CHOICE_COSTS = [
    *(word for word in GREEDY_ROLLOUT if not word.startswith("algorithm")), "algorithm=choice_costs",
    "algorithm.instances=3", "algorithm.rounds=2",
]  # fmt: skip

SELF_LABELLING = [
    "algorithm=self_labelling", *(word for word in TINY if ".ppo." not in word), "algorithm.instances=2",
    "algorithm.episodes=2",
]  # fmt: skip


DEMONSTRATIONS = [
    "env=murse", "policy=schedulenet", "algorithm=demonstrations", "curriculum=rounds", "env.scales=[small,medium]",
    "policy.width=2", "policy.heads=2", "policy.layers=2", "policy.hidden=4", "algorithm.instances=2",
    "algorithm.problems=6", "algorithm.expert=lst", "algorithm.expert_options=null", "algorithm.criterion=values",
    "algorithm.minibatch=16", "updates=4", "save_every=2", "validation.every=2", "validation.instances=2",
    "validation.length=1",
]  # fmt: skip


class StoppedError(Exception):
    """Something from outside ends the run."""


def stop_in_update(monkeypatch: pytest.MonkeyPatch, update: int) -> None:
    original = RunLog.on_update

    def interrupted(self: RunLog, run: Run, values: dict[str, float]) -> None:
        original(self, run, values)
        if values["update"] == update:
            raise StoppedError

    monkeypatch.setattr(RunLog, "on_update", interrupted)


def checkpoint(directory: Path) -> dict[str, np.ndarray]:
    tensors = load_file(directory / read_json(directory / "checkpoint.json")["tensors"])
    return {name: tensor.numpy() for name, tensor in tensors.items()}


def rows(directory: Path) -> list[dict[str, str]]:
    with (directory / "progress.csv").open(newline="") as file:
        return [
            {name: value for name, value in row.items() if name not in ("seconds", "frames_per_second")}
            for row in csv.DictReader(file)
        ]


@pytest.mark.parametrize(
    "overrides",
    [
        GAE,
        STEP_BASELINE,
        IPPO,
        STATE_VALUE,
        RANDOM_VIEW,
        SELF_LABELLING,
        GREEDY_ROLLOUT,
        pytest.param(CHOICE_COSTS, marks=pytest.mark.slow),
        DEMONSTRATIONS,
        pytest.param(IMITATION, marks=pytest.mark.slow),
        pytest.param(ROLLOUT_IMITATION, marks=pytest.mark.slow),
    ],
    ids=[
        "gae",
        "step_baseline",
        "ippo",
        "state_value",
        "random view",
        "self_labelling",
        "greedy_rollout",
        "choice_costs",
        "demonstrations",
        "imitation",
        "rollout_imitation",
    ],
)
def test_a_resumed_run_ends_as_one_that_never_stopped(
    overrides: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    whole, halved = tmp_path / "whole", tmp_path / "halved"
    train_from_overrides([*overrides, f"run_dir={whole}"], quiet=True)
    with monkeypatch.context() as patch:
        stop_in_update(patch, 3)
        with pytest.raises(StoppedError):
            train_from_overrides([*overrides, f"run_dir={halved}"], quiet=True)
    assert read_json(halved / "checkpoint.json")["counters"]["update"] == 2
    resume(halved, quiet=True)
    expected, found = checkpoint(whole), checkpoint(halved)
    assert expected.keys() == found.keys()
    for name, tensor in expected.items():
        assert np.array_equal(tensor, found[name]), name
    assert rows(whole) == rows(halved)
    assert [row["update"] for row in rows(halved)] == ["1", "2", "3", "4"]
    assert (whole / "policy.safetensors").read_bytes() == (halved / "policy.safetensors").read_bytes()


@pytest.mark.parametrize("overrides", [GAE, STEP_BASELINE], ids=["gae", "step_baseline"])
def test_a_run_that_stopped_before_its_first_update_is_resumed_from_the_start(
    overrides: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    train_from_overrides([*overrides, "updates=2", f"run_dir={whole}"], quiet=True)
    with monkeypatch.context() as patch:
        stop_in_update(patch, 1)
        with pytest.raises(StoppedError):
            train_from_overrides([*overrides, "updates=2", f"run_dir={stopped}"], quiet=True)
    assert read_json(stopped / "checkpoint.json")["counters"]["update"] == 0
    resume(stopped, quiet=True)
    expected, found = checkpoint(whole), checkpoint(stopped)
    assert expected.keys() == found.keys()
    for name, tensor in expected.items():
        assert np.array_equal(tensor, found[name]), name
    assert rows(whole) == rows(stopped)


def test_learning_changes_the_weights_and_seeds_change_the_run(tmp_path: Path):
    runs = {}
    for seed in (0, 1):
        runs[seed] = checkpoint(
            train_from_overrides([*GAE, f"seed={seed}", f"run_dir={tmp_path / str(seed)}"], quiet=True)
        )
    fresh = build(RunRecord(config=load_config(GAE), overrides=GAE, revision="")).learner.policy.state_dict()
    changed = [not np.array_equal(tensor.numpy(), runs[0][f"policy.{name}"]) for name, tensor in fresh.items()]
    assert any(changed)
    assert any(not np.array_equal(runs[0][name], runs[1][name]) for name in runs[0] if name.startswith("policy."))


def test_the_best_policy_is_kept_with_a_card_that_says_how_it_was_made(tmp_path: Path):
    directory = train_from_overrides([*GAE, f"run_dir={tmp_path / 'run'}"], quiet=True)
    card = read_json(directory / "policy.json")
    assert card["command"] == "marl-sched train " + " ".join(GAE)
    assert card["view"] == {"kind": "local", "reach": 1, "comm": 1, "staleness": 0}
    assert card["training_knowledge"] == "a critic on the full graph"
    scores = [float(row["validation"]) for row in rows(directory) if row["validation"]]
    assert card["scores"]["validation"]["M1"] == pytest.approx(max(scores), abs=1e-6)
    assert NetworkPolicy.load(directory / "policy.safetensors").card is not None


def test_every_update_is_logged_as_csv_and_for_tensorboard(tmp_path: Path):
    directory = train_from_overrides([*GAE, f"run_dir={tmp_path / 'run'}"], quiet=True)
    assert all(float(row["decisions"]) > 0 and float(row["reward_rate"]) for row in rows(directory))
    assert [bool(row["validation"]) for row in rows(directory)] == [False, True, False, True]
    assert list((directory / "tensorboard").glob("events.out.tfevents.*"))


def test_a_run_is_not_written_over_another(tmp_path: Path):
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(InvalidOptionError, match="holds a run already"):
        train_from_overrides([*GAE, f"run_dir={tmp_path}"], quiet=True)


@pytest.mark.parametrize("damage", ["no checkpoint", "truncated tensors", "another network"])
def test_a_damaged_checkpoint_is_refused_by_name(damage: str, tmp_path: Path):
    directory = train_from_overrides([*GAE, "updates=2", f"run_dir={tmp_path / 'run'}"], quiet=True)
    numbers = directory / "checkpoint.json"
    tensors = directory / read_json(numbers)["tensors"]
    if damage == "no checkpoint":
        numbers.unlink()
    elif damage == "truncated tensors":
        tensors.write_bytes(tensors.read_bytes()[:-10])
    else:
        text = (directory / "config.json").read_text()
        (directory / "config.json").write_text(text.replace('"layers": 2', '"layers": 3', 1))
    with pytest.raises(InvalidFileError, match=r"checkpoint"):
        resume(directory, quiet=True)


def test_resuming_what_is_no_run_is_refused(tmp_path: Path):
    with pytest.raises(InvalidFileError, match=r"config\.json"):
        resume(tmp_path, quiet=True)


def test_a_run_that_goes_on_with_another_source_says_so_and_its_cards_name_both(tmp_path: Path):
    directory = train_from_overrides([*GAE, "updates=2", f"run_dir={tmp_path}"], quiet=True)
    record = read_json(directory / "config.json")
    record["revision"], record["config"]["updates"] = "abc", 4
    write_json(directory / "config.json", record)
    with pytest.warns(UserWarning, match="another source than before: abc, then "):
        resume(directory, quiet=True)
    assert load_record(directory / "config.json").resumed_on == [source_revision()]
    build(load_record(directory / "config.json")).validate(Counters(update=4), directory)
    assert read_card(directory / "policy.json").git_hash == f"abc, then {source_revision()}"


def test_a_resumed_run_does_not_need_the_policy_that_it_started_from(tmp_path: Path):
    first = train_from_overrides([*GAE, "updates=1", f"run_dir={tmp_path / 'first'}"], quiet=True)
    start = first / "policy.safetensors"
    second = train_from_overrides([*GAE, "updates=2", f"start_from={start}", f"run_dir={tmp_path / 'b'}"], quiet=True)
    kept = load_record(second / "config.json").start
    assert kept is not None
    assert kept.weights_sha256 == read_card(first / "policy.json").weights_sha256
    assert kept.command == read_card(first / "policy.json").command
    start.unlink()
    (second / "config.json").write_text((second / "config.json").read_text().replace('"updates": 2', '"updates": 4'))
    resume(second, quiet=True)
    assert rows(second)[-1]["update"] == "4"


def test_a_resumed_run_keeps_its_points_for_tensorboard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as patch:
        stop_in_update(patch, 3)
        with pytest.raises(StoppedError):
            train_from_overrides([*GAE, f"run_dir={tmp_path}"], quiet=True)
    resume(tmp_path, quiet=True)
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [event.step for event in events.Scalars("reward_rate")] == [1, 2, 3, 4]
    assert [event.step for event in events.Scalars("validation")] == [2, 4]


def test_a_network_that_is_bound_to_the_largest_scale_is_validated_on_the_smaller_one(tmp_path: Path):
    words = [word for word in STEP_BASELINE if not word.startswith("policy.")]
    bound = [*words, "policy=deeprm", "env.scales=[small, medium]", "updates=2", f"run_dir={tmp_path}"]
    directory = train_from_overrides(bound, quiet=True)
    assert [bool(row["validation"]) for row in rows(directory)] == [False, True]


@pytest.mark.parametrize(("better", "best"), [("higher", 0.7), ("lower", 0.5)])
def test_the_best_score_is_the_lowest_where_lower_is_better(better: str, best: float):
    validation = Validation(load_config(GAE))
    validation._domain = replace(validation._domain, better=better)
    assert validation.prefers(best, 0.6)
    assert not validation.prefers(0.6, best)
    assert not validation.prefers(best, best)


def test_every_scale_is_validated_and_counts_by_its_ratio_to_the_baseline():
    words = ["env=murse", "env.scales=[small,medium]", "+env.options.durations=deterministic"]
    words += ["validation.instances=3", "validation.length=1", "validation.baseline=lst", "policy=hetgat_residual"]
    config = load_config(words)
    validation = Validation(config)
    network = config.policy.build(get_domain("murse").make_simulator(validation._problems["small"].instances).graph)
    means = validation(network)
    for scale, problem in validation._problems.items():
        played = evaluate_scheduler(problem, NetworkPolicy(network, domain="murse"))
        assert means[scale] == played.measures["makespan"].mean()
    base = {s: evaluate_scheduler(p, create_scheduler("lst", "murse")) for s, p in validation._problems.items()}
    ratios = [means[scale] / one.measures["makespan"].mean() for scale, one in base.items()]
    assert validation.score(means) == pytest.approx(sum(ratios) / 2)


def test_hooks_are_called_in_their_order_and_leave_the_run_as_it_is(tmp_path: Path):
    called: list[str] = []

    class Listening(Callback):
        def on_start(self, run: Run) -> None:
            called.append(f"start {run.counters.update}")

        def on_rollout(self, run: Run, rollout: Rollout) -> None:
            called.append(f"rollout {rollout.turns}")

        def on_validation(self, run: Run, score: float) -> None:
            called.append("validation")

        def on_update(self, run: Run, values: Mapping[str, float]) -> None:
            called.append(f"update {values['update']}")

        def on_end(self, run: Run) -> None:
            called.append("end")

    config = load_config([*GAE, "updates=2", f"run_dir={tmp_path / 'heard'}"])
    heard = train(config, [Listening()], quiet=True)
    once = ["rollout 12", "update 1", "rollout 12", "validation", "update 2"]
    assert called == ["start 0", *once, "end"]
    alone = train_from_overrides([*GAE, "updates=2", f"run_dir={tmp_path / 'alone'}"], quiet=True)
    assert rows(heard) == rows(alone)


def test_the_logs_columns_are_what_was_logged_and_a_logger_is_a_word(tmp_path: Path):
    words = [*STEP_BASELINE, "updates=2", "logger=csv", f"run_dir={tmp_path / 'run'}"]
    directory = train_from_overrides(words, quiet=True)
    columns = rows(directory)[0].keys()
    assert "kl" in columns
    assert "regret" not in columns
    assert list((directory / "csv").rglob("reward_rate.csv"))


def test_a_logger_that_is_not_installed_is_named_with_its_extra_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("marl_sched.train.callbacks.find_spec", lambda name: None)
    with pytest.raises(
        MarlSchedError, match=r"logger=wandb: wandb is not installed: pip install 'marl-sched\[wandb\]'"
    ):
        train_from_overrides([*STEP_BASELINE, "logger=wandb", f"run_dir={tmp_path / 'run'}"], quiet=True)
    assert not (tmp_path / "run").exists()
