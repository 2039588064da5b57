"""A training run from its configuration to a policy: collect, learn, evaluate, log, save."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import msgspec
import numpy as np
import torch
from msgspec import structs

from marl_sched.agents.policies.cards import source_revision
from marl_sched.errors import InvalidOptionError
from marl_sched.files import write_json
from marl_sched.train.callbacks import Callback, LoggerCallback, Run
from marl_sched.train.checkpoint import Counters
from marl_sched.train.collect import Experience
from marl_sched.train.config import RunRecord, TrainConfig, load_config, load_record
from marl_sched.train.export import CONFIG
from marl_sched.train.guard import exclusive, stopping
from marl_sched.train.logging import RunLog
from marl_sched.train.malloc import keep_freed_memory
from marl_sched.train.parts import Parts, build

_SAMPLES = 2  # last word of the seeds that pick and order samples


def train(
    config: TrainConfig, callbacks: Sequence[Callback] = (), *, overrides: Sequence[str] = (), quiet: bool = False
) -> Path:
    """Train as a configuration says (`load_config`); the directory that holds the run.

    `callbacks` are called in their order, after the run's own log; `overrides` are those that gave the configuration,
    for the command on the policy's card. Raises InvalidOptionError for a directory that holds a run already.
    """
    directory = Path(config.directory())
    _require_no_run(directory)
    callbacks = [*_own(config, quiet=quiet), *callbacks]
    record = RunRecord(config=config, overrides=list(overrides), revision=source_revision())
    parts, counters = build(record), Counters()  # before the folder, so that what cannot be trained leaves none
    if config.start_from is not None:
        parts = replace(parts, record=structs.replace(record, start=parts.start_from(config.start_from)))
    with exclusive(directory):
        _require_no_run(directory)  # another process may have begun one by now
        parts.save(counters, directory)  # first, so that whatever holds a run can be resumed
        write_json(directory / CONFIG, msgspec.to_builtins(parts.record))
        return _loop(parts, counters, directory, callbacks)


def _require_no_run(directory: Path) -> None:
    if (directory / CONFIG).exists():
        raise InvalidOptionError(
            f"run_dir: {directory} holds a run already: go on with it by `marl-sched resume {directory}`, or "
            "choose another folder with run_dir=DIR"
        )


def train_from_overrides(overrides: Sequence[str], *, quiet: bool = False) -> Path:
    """Run `marl-sched train` with Hydra overrides such as `view=local`; the directory that holds the run.

    Raises InvalidOptionError for a bad override or a directory that holds a run already.
    """
    return train(load_config(overrides), overrides=overrides, quiet=quiet)


def resume(run_dir: str | Path, callbacks: Sequence[Callback] = (), *, quiet: bool = False) -> Path:
    """Go on with a run from its last checkpoint as if it had not stopped: exactly so on a CPU.

    On a GPU sums are made in no fixed order. A checkpoint is not bound to the device on which it was made. If the
    source is another one by now, that may change what is learned: the record and the cards from here on name both.
    """
    directory = Path(run_dir)
    record, revision = load_record(directory / CONFIG), source_revision()
    with exclusive(directory):
        if revision != [record.revision, *record.resumed_on][-1]:
            record = structs.replace(record, resumed_on=[*record.resumed_on, revision])
            write_json(directory / CONFIG, msgspec.to_builtins(record))
            warnings.warn(f"{directory}: goes on with another source than before: {record.source}", stacklevel=2)
        parts = build(record)
        callbacks = [*_own(record.config, quiet=quiet), *callbacks]
        return _loop(parts, parts.restore(directory), directory, callbacks)


def _own(config: TrainConfig, *, quiet: bool) -> list[Callback]:
    """The run's own callbacks; MarlSchedError for a logger whose package is not installed."""
    return [RunLog(quiet=quiet), *([] if config.logger is None else [LoggerCallback(config.logger)])]


def _loop(parts: Parts, counters: Counters, directory: Path, callbacks: Sequence[Callback]) -> Path:
    """The loop. Everything random in an update is a function of (seed, update, instance number).

    The first SIGINT or SIGTERM ends it after the running update, with a checkpoint.
    """
    config, run = parts.record.config, Run(parts, counters, directory)
    torch.set_num_threads(config.threads)
    keep_freed_memory()
    with stopping() as stop, _called(callbacks, run) as everyone:
        while counters.update < config.updates and not stop.requested:
            started = time.perf_counter()
            update = counters.update
            rollout = parts.collector.collect(parts.learner.policy, parts.length(update))
            for callback in everyone:
                callback.on_rollout(run, rollout)
            rng = np.random.default_rng([config.seed, update, _SAMPLES])
            report = parts.learner.learn(rollout, update / config.updates, rng)
            counters.update += 1
            counters.time += rollout.time
            counters.decisions += rollout.decisions
            scores = parts.validate(counters, directory)
            counters.seconds += time.perf_counter() - started
            for callback in everyone if scores else ():
                callback.on_validation(run, scores["validation"])
            values = _row(counters, rollout) | report | scores
            for callback in everyone:
                callback.on_update(run, values)
            parts.save(counters, directory)
        if stop.requested:
            parts.save(counters, directory, now=True)
    stop.leave(f"stopped after update {counters.update}: go on with it by `marl-sched resume {directory}`")
    return directory


@contextmanager
def _called(callbacks: Sequence[Callback], run: Run) -> Iterator[Sequence[Callback]]:
    """Start callbacks, and end those that started and the collector's workers whatever happens in between."""
    with ExitStack() as stack:
        stack.callback(run.parts.collector.close)
        for callback in callbacks:
            stack.callback(callback.on_end, run)
            callback.on_start(run)
        yield callbacks


def _row(counters: Counters, rollout: Experience) -> dict[str, float]:
    """What is logged of an update beside the learner's report."""
    done = asdict(counters)
    del done["best"]  # told with the validation that found it
    return {
        **done,
        "reward_rate": rollout.reward_rate,
        "length": rollout.length,
        "frames_per_second": rollout.decisions / rollout.seconds,
    }
