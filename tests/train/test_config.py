from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from marl_sched.domain import get_domain
from marl_sched.envs.airme.views import FullView, LocalView
from marl_sched.errors import InvalidFileError, InvalidOptionError, UnknownNameError
from marl_sched.files import write_json
from marl_sched.train.algorithms.critic import GaeConfig
from marl_sched.train.algorithms.step_baseline import StepBaselineConfig
from marl_sched.train.config import RENAMED, RunRecord, load_config, load_record


def test_defaults_are_the_recipe_of_the_full_view():
    config = load_config([])
    assert config.make_view() == FullView()
    assert isinstance(config.algorithm, GaeConfig)
    assert (config.policy.width, config.policy.heads, config.policy.layers) == (8, 4, 3)


def test_groups_and_overrides_reach_their_fields():
    config = load_config(["view=local", "view.reach=2", "policy=published", "algorithm=step_baseline", "seed=5"])
    assert config.make_view() == LocalView(reach=2, comm=1, staleness=0)
    assert config.policy.width == 32
    assert isinstance(config.algorithm, StepBaselineConfig)
    assert config.algorithm.episodes == 8
    assert config.seed == 5


def test_published_curriculum_is_the_dissertations():
    curriculum = load_config(["curriculum=growing"]).curriculum
    assert (curriculum.start, curriculum.step, curriculum.stop, curriculum.spread) == (50, 0.8, 200, 30)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("rounds=3", "rounds"),
        ("+rounds=3", "unknown field `rounds`"),
        ("+algorithm.lambda=1", "unknown field `lambda` - at `$.algorithm`"),
        ("+view.reach=1", "view full: reach: expected an option of this view of airme: none"),
        ("algorithm.ppo.epochs=0", "`int` >= 1 - at `$.algorithm.ppo.epochs`"),
        ("seed=many", "Expected `int`, got `str` - at `$.seed`"),
        ("+env.options.speed=2", "env.options.speed: the simulator of airme has no such option"),
        ("+env.options.horizon=2", "env.options.horizon"),
        ("view=panorama", "Available options in 'view'"),
    ],
)
def test_a_bad_override_gives_one_line_that_says_where(override: str, message: str):
    with pytest.raises(InvalidOptionError) as caught:
        load_config([override])
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("override", ["env.scales=[tiny]", "env.objective=fame", "env.name=mars"])
def test_unknown_names_are_refused_before_anything_runs(override: str):
    with pytest.raises(UnknownNameError):
        load_config([override])


def test_every_domain_and_its_views_bring_their_own_groups():
    config = load_config(["env=murse", "view=local", "view.sensing=2.5"])
    murse = get_domain("murse")
    assert (config.env.name, config.env.scales, config.env.objective) == ("murse", ["small"], "makespan")
    assert config.make_view() == murse.view("local", sensing=2.5)
    assert config.curriculum.stop == murse.default_horizon


def test_runs_that_differ_in_view_algorithm_or_network_have_folders_of_their_own():
    groups = [[], ["view=local"], ["view=local", "view.reach=2"], ["algorithm=ippo"], ["policy=decima"], ["seed=1"]]
    folders = [load_config(overrides).directory() for overrides in groups]
    assert folders[0] == "runs/airme-full-profit-hetgat-gae-seed0"
    assert folders[2] == "runs/airme-local-2-1-0-profit-hetgat-gae-seed0"
    assert len(set(folders)) == len(folders)


def test_a_record_survives_its_file_and_names_the_command_without_its_place(tmp_path: Path):
    overrides = ["view=local", "env.scales=[small, medium]", "run_dir=/somewhere"]
    record = RunRecord(config=load_config(overrides), overrides=overrides, revision="abc")
    write_json(tmp_path / "config.json", msgspec.to_builtins(record))
    assert load_record(tmp_path / "config.json") == record
    assert record.command == "marl-sched train view=local 'env.scales=[small, medium]'"


def test_a_record_with_an_unknown_key_is_refused_by_file(tmp_path: Path):
    record = RunRecord(config=load_config([]), overrides=[], revision="")
    write_json(tmp_path / "config.json", msgspec.to_builtins(record) | {"rounds": 3})
    with pytest.raises(InvalidFileError, match=r"config\.json: expected the record of a training run: .*rounds"):
        load_record(tmp_path / "config.json")


@pytest.mark.parametrize(("old", "new"), sorted(RENAMED.items()))
def test_an_old_option_name_is_refused_with_the_new_one(old: str, new: str):
    with pytest.raises(InvalidOptionError, match=rf"algorithm\.ppo\.{old} was renamed: expected algorithm\.ppo\.{new}"):
        load_config([f"algorithm.ppo.{old}=1"])


def test_a_record_with_an_old_option_name_is_refused_with_the_new_one(tmp_path: Path):
    record = msgspec.to_builtins(RunRecord(config=load_config([]), overrides=[], revision=""))
    record["config"]["algorithm"]["trace"] = record["config"]["algorithm"].pop("gae_lambda")
    write_json(tmp_path / "config.json", record)
    with pytest.raises(InvalidFileError, match=r"config\.algorithm\.trace was renamed: expected .*gae_lambda"):
        load_record(tmp_path / "config.json")


@pytest.mark.parametrize("folder", ["runs/a=b", "runs/für", "runs/a#b", 'runs/a "b"', "runs/back\\slash"])
def test_values_that_hydra_has_other_uses_for_need_no_quotes(folder):
    assert load_config([f"run_dir={folder}"]).run_dir == folder


def test_several_values_where_one_is_meant_are_refused():
    with pytest.raises(InvalidOptionError, match=r"^train: seed=0,1: expected one value; start a run for each of 0,1"):
        load_config(["seed=0,1"])
