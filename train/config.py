"""The configuration of a training run: what `configs/train.yaml` and its groups may hold, and nothing else.

Hydra composes the YAML files and the overrides of the command line; the result is converted to the classes
below, whose fields have the names of the YAML keys. A key that is not a field, a value of another type or
outside its bounds gives one line that says where.
"""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from msgspec import Meta
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from marl_sched.agents.networks.registry import NetworkConfig, network_config
from marl_sched.agents.policies.cards import Mode
from marl_sched.domain import get_domain
from marl_sched.errors import InvalidFileError, InvalidOptionError
from marl_sched.files import read_json
from marl_sched.train.algorithms.base import AlgorithmConfig, algorithm_config
from marl_sched.train.bounds import Count, Group, Natural, NonNegative, Seed
from marl_sched.train.callbacks import LoggerName
from marl_sched.train.collect import CollectorName
from marl_sched.train.device import DeviceName
from marl_sched.train.groups import chosen_domain, offer

# Arguments of every domain's simulator that other keys of the configuration, or the trainer, decide on.
_SET_ELSEWHERE = {"instances", "view", "objective", "horizon", "seed", "pad"}

# Options that had another name before version 0.2.0, at the end of their path: old name -> new name.
RENAMED = {
    "trace": "gae_lambda",
    "centred": "reward_centering",
    "critic_alone": "critic_warmup",
    "keep_least": "min_keep_prob",
    "max_gradient": "max_grad_norm",
}


class EnvConfig(Group, frozen=True, kw_only=True):
    """The domain, the scales from which instances are drawn in turn, the reward, and simulator options."""

    name: str
    scales: Annotated[list[str], Meta(min_length=1)]
    objective: str
    options: dict[str, Any]


class CurriculumConfig(Group, frozen=True, kw_only=True):
    """Episode length in simulated time: see marl_sched.train.curriculum."""

    start: Count
    step: NonNegative
    stop: Count
    spread: Natural


class ValidationConfig(Group, frozen=True, kw_only=True):
    """Evaluation every so many updates on fixed instances of every scale, `length` None: whole episodes.

    Policies are compared by the mean over scales of M1; `baseline`, a scheduler's name, is one whose M1 each scale's is
    divided by, so that every scale counts the same. `mode` is how the policy decides there, and then wherever its card
    is loaded.
    """

    every: Count
    instances: Count
    episodes: Count
    seed: Seed
    length: Count | None
    mode: Mode
    baseline: str | None = None


class CollectorConfig(Group, frozen=True, kw_only=True):
    """How turns are collected: see marl_sched.train.collect. `workers` are those of multi and ray."""

    name: CollectorName
    workers: Count


class TrainConfig(Group, frozen=True, kw_only=True):
    """A whole run; `configs/train.yaml`. `start_from`: a policy, by name or path, to go on from.

    `device`: where networks learn (marl_sched.train.device), `logger`: where the log's numbers go
    beside `progress.csv`.
    """

    env: EnvConfig
    view: dict[str, Any]
    policy: NetworkConfig
    algorithm: AlgorithmConfig
    collector: CollectorConfig
    curriculum: CurriculumConfig
    validation: ValidationConfig
    start_from: str | None
    seed: Seed
    updates: Count
    threads: Count
    device: DeviceName
    logger: LoggerName | None
    run_dir: str | None
    save_every: Count

    def directory(self) -> str:
        """Where the run is written; by default after what most runs differ in."""
        view = "-".join(str(value) for value in self.view.values())
        network, algorithm = self.policy.network_name(), self.algorithm.algorithm_name()
        names = (self.env.name, view, self.env.objective, network, algorithm, f"seed{self.seed}")
        return self.run_dir or f"runs/{'-'.join(str(name) for name in names)}"

    def make_view(self) -> Any:
        """The domain's view object that `view` describes."""
        return get_domain(self.env.name).make_view(self.view)


class Start(Group, frozen=True, kw_only=True):
    """The policy that a run goes on from, as its card had it when the run began."""

    weights_sha256: str
    command: str
    knowledge: str


class RunRecord(Group, frozen=True, kw_only=True):
    """`config.json` of a run: the configuration, the overrides that gave it, the source that it runs on.

    `start` belongs to `start_from`, `resumed_on` are further revisions of the source, on which it went on later.
    """

    config: TrainConfig
    overrides: list[str]
    revision: str
    start: Start | None = None
    resumed_on: list[str] = msgspec.field(default_factory=list)

    @property
    def source(self) -> str:
        """Every revision of the source that the run has run on, in their order."""
        return ", then ".join([self.revision, *self.resumed_on])

    @property
    def command(self) -> str:
        """What to type to make the run again, wherever it is written."""
        overrides = (override for override in self.overrides if not override.startswith("run_dir="))
        return shlex.join(["marl-sched", "train", *overrides])


def load_config(overrides: Sequence[str]) -> TrainConfig:
    """The configuration that Hydra overrides such as `view=local view.reach=2` make of `configs/train.yaml`.

    Raises InvalidOptionError for an override that Hydra cannot apply, an unknown key or a bad value, and
    UnknownNameError for a domain, scale, objective or view that is not registered.
    """
    for override in overrides:
        path = override.partition("=")[0].lstrip("+~")
        _refuse_renamed(path.split("."))
    GlobalHydra.instance().clear()
    offer(chosen_domain(overrides))
    try:
        with initialize_config_module("marl_sched.configs", version_base="1.3"):
            composed = OmegaConf.to_container(compose("train", [_quoted(one) for one in overrides]), resolve=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise InvalidOptionError(f"train: {_one_line(error)}") from error
    _refuse_renamed_in(composed)
    try:
        config = msgspec.convert(composed, TrainConfig, dec_hook=_registered)
    except msgspec.ValidationError as error:
        raise InvalidOptionError(f"train: {error}") from error
    return _checked(config)


def _quoted(override: str) -> str:
    """An override as Hydra's grammar takes it: a value with `=`, `#`, umlauts and the like is put into quotes.

    Raises InvalidOptionError for what is no override, and for several values where one is meant.
    """
    parser = OverridesParser.create()
    name, equals, value = override.partition("=")
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    for words in (override, f'{name}="{escaped}"'):
        try:
            parsed = parser.parse_override(words)
        except HydraException:
            continue
        if parsed.is_sweep_override():
            raise InvalidOptionError(f"train: {override}: expected one value; start a run for each of {value}")
        return words
    expected = "NAME=VALUE" if not equals else "a name of the configuration before ="
    raise InvalidOptionError(f"train: {override}: expected {expected}")


def load_record(path: Path) -> RunRecord:
    """The record of a run, from its `config.json`; InvalidFileError if it does not hold one."""
    content = read_json(path)
    try:
        _refuse_renamed_in(content)
        record = msgspec.convert(content, RunRecord, dec_hook=_registered)
    except InvalidOptionError as error:
        raise InvalidFileError(path, "config", f"options of this version ({error})") from error
    except msgspec.ValidationError as error:
        raise InvalidFileError(path, "", f"the record of a training run: {error}") from error
    _checked(record.config)
    return record


def _registered(kind: type, content: Any) -> Any:
    """Msgspec's hook for the groups whose struct a registry has."""
    if not isinstance(content, dict):
        raise TypeError(f"expected a group of settings, got {content!r}")
    return network_config(content) if kind is NetworkConfig else algorithm_config(content)


def _checked(config: TrainConfig) -> TrainConfig:
    """Look up every name in the registry of domains."""
    domain = get_domain(config.env.name)
    for scale in config.env.scales:
        domain.require_scale(scale)
    domain.require_objective(config.env.objective)
    known = set(inspect.signature(domain.simulator).parameters) - _SET_ELSEWHERE
    for option in config.env.options:
        if option not in known:
            raise InvalidOptionError(
                f"train: env.options.{option}: the simulator of {domain.name} has no such option to set here; "
                f"known: {', '.join(sorted(known))}"
            )
    config.make_view()
    return config


def _refuse_renamed(path: Sequence[str]) -> None:
    """Raise InvalidOptionError that gives the new name of an option that was renamed; `path` is its keys."""
    if path[-1] in RENAMED:
        new = ".".join([*path[:-1], RENAMED[path[-1]]])
        raise InvalidOptionError(f"train: {'.'.join(path)} was renamed: expected {new}")


def _refuse_renamed_in(content: Any, path: tuple[str, ...] = ()) -> None:
    """Raise InvalidOptionError for the first renamed option in nested mappings."""
    for key, value in content.items() if isinstance(content, dict) else ():
        _refuse_renamed([*path, key])
        _refuse_renamed_in(value, (*path, key))


def _one_line(error: Exception) -> str:
    """Hydra's message without its advice to add keys, which would only be refused later, and its search path."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    told = [line for line in lines if not line.startswith(("To append", "Config search path", "provider=", "See "))]
    return " ".join(told)
