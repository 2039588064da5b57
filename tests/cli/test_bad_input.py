"""Whatever is wrong: one line that says what and where, exit code 2, no traceback, nothing half-written."""

import json
import re
import socket
import subprocess
import sys

import pytest

from marl_sched.domain import get_domain

SHORT = ("--instances", 2, "--episodes", 1, "--hours", 12)


def refused(ended, *pieces):
    assert ended.code == 2
    assert ended.out == ""
    assert ended.err.startswith("error: ")
    assert ended.err.endswith("\n")
    assert ended.err.count("\n") == 1
    assert "Traceback" not in ended.err
    for piece in pieces:
        assert str(piece) in ended.err


@pytest.fixture
def fleet(tmp_path):
    """A folder with one good instance file."""
    folder = tmp_path / "fleet"
    get_domain("airme").instances("small", 1, 1)[0].save(folder / "fleet.json")
    return folder


@pytest.mark.parametrize(
    ("options", "pieces"),
    [
        (("--schedulers", "corective"), ["unknown scheduler 'corective'", "did you mean 'corrective'"]),
        (("--schedulers", "condition,nobody"), ["unknown scheduler 'nobody'"]),
        (("--schedulers", ","), ["--schedulers: expected at least one name"]),
        (("--schedulers", "condition", "--view", "globe"), ["unknown view of airme 'globe'", "full, local"]),
        (("--schedulers", "condition", "--scale", "huge"), ["unknown scale of airme 'huge'", "large, medium, small"]),
        (("--schedulers", "condition", "--env", "airma"), ["unknown environment 'airma'", "did you mean 'airme'"]),
        (
            ("--schedulers", "condition", "--rounds", "3"),
            ["unknown option of airme with view full '--rounds'", "--hours"],
        ),
        (
            ("--schedulers", "condition", "--view", "local", "--comm", "1.5"),
            ["view local: comm: expected an integer, got 1.5"],
        ),
        (
            ("--schedulers", "condition", "--view", "local", "--sensing", "2"),
            ["unknown option of airme with view local '--sensing'", "--comm, --env", "--staleness"],
        ),
        (("--schedulers", "condition", "--view", "local", "--comm", "nan"), ["comm: expected an integer, got nan"]),
        (("--schedulers", "condition", "--view", "local", "--comm", "inf"), ["comm: expected an integer, got inf"]),
        (("--schedulers", "condition", "--objective", "fame"), ["unknown objective of airme 'fame'"]),
        (("--schedulers", "condition", "--baseline", "random"), ["unknown baseline 'random'", "condition"]),
        (("--schedulers", "condition", "--failure", "never"), ["failure", "'density' or 'hazard'", "'never'"]),
        (("--schedulers", "condition", "--scheme", "half"), ["unknown scheme 'half'"]),
        (
            ("--schedulers", "condition", "--view", "local", "--reach", "-1"),
            ["view local: reach: expected an integer", "-1"],
        ),
        (
            ("--schedulers", "condition", "--view", "local", "--reach", "near"),
            ["view local: reach: expected an integer, got 'near'"],
        ),
        (
            ("--schedulers", "condition", "--reach", "1"),
            ["unknown option of airme with view full '--reach'"],
        ),
        (("--schedulers", "condition", "--instances", "0"), ["--instances: expected at least 1, got 0"]),
        (("--schedulers", "condition", "--instances", "nowhere"), ["--instances", "'nowhere'"]),
        (("--schedulers", "condition", "--episodes", "0"), ["--episodes"]),
        (("--schedulers", "condition", "--hours", "0"), ["--hours"]),
        (("--schedulers", "condition", "--seed", "-1"), ["--seed"]),
        (("--schedulers", "condition", "--seed", "9223372036854775808"), ["--seed", "9223372036854775807"]),
        (("--schedulers", "condition", "--colour", "red"), ["unknown option of airme with view full '--colour'"]),
        (("--schedulers", "condition", "--episode", "3"), ["did you mean '--episodes'"]),
        (("--schedulers", "condition", "--hours"), ["--hours: expected a value after it"]),
        (("--schedulers", "condition", "red"), ["red: expected an option such as --name value"]),
        (("--scheduler", "nowhere.at:all"), ["nowhere.at:all: expected a module that can be imported"]),
        (("--scheduler", "builtins:dict"), ["builtins:dict: expected a factory of a Scheduler, got dict"]),
        ((), ["--schedulers: expected at least one name"]),
    ],
)
def test_evaluate_refuses(run, options, pieces):
    refused(run("evaluate", *options), *pieces)


def test_an_unknown_command_is_refused(run):
    refused(run("evaluat"), "evaluat")


def test_an_unknown_environment_is_refused_before_anything_is_written(run, tmp_path):
    refused(run("generate", "boats", "--out", tmp_path / "out"), "unknown environment 'boats'")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("damage", "pieces"),
    [
        (lambda text: text[: len(text) // 2], ["line ", "valid JSON"]),
        (lambda text: "", ["line 1 column 1"]),
        (lambda text: text.replace('"n_crews": 7', '"n_crews": -7'), ["n_crews", "-7"]),
        (lambda text: text.replace('"landings"', '"landing"', 1), ["planes[0]", "landings"]),
        (lambda text: text.replace('"env": "airme"', '"env": "boats"'), ["env", "'airme'"]),
        (lambda text: re.sub(r'"schema": \d+', '"schema": 99', text), ["schema", "99"]),
    ],
    ids=["truncated", "empty", "negative crews", "missing field", "another environment", "another schema"],
)
def test_a_damaged_instance_is_named_with_file_and_field(run, fleet, tmp_path, damage, pieces):
    good = (fleet / "fleet.json").read_text()
    crews = json.loads(good)["n_crews"]
    (fleet / "worse.json").write_text(damage(good.replace(f'"n_crews": {crews}', '"n_crews": 7')))
    ended = run("evaluate", "--schedulers", "condition", "--instances", fleet, "--json", tmp_path / "r.json")
    refused(ended, fleet / "worse.json", *pieces)
    assert not (tmp_path / "r.json").exists()


def test_bytes_that_are_no_text_are_refused(run, fleet):
    (fleet / "worse.json").write_bytes(b"\xff\xfe\x00")
    refused(run("evaluate", "--schedulers", "condition", "--instances", fleet), fleet / "worse.json", "UTF-8")


def test_a_folder_without_instances_is_refused(run, tmp_path):
    refused(
        run("evaluate", "--schedulers", "condition", "--instances", tmp_path),
        tmp_path,
        "expected at least one instance file",
    )


def test_a_checkpoint_that_is_not_there_is_refused(run, tmp_path):
    refused(run("evaluate", "--schedulers", tmp_path / "mine.safetensors", *SHORT), tmp_path / "mine")


@pytest.mark.parametrize("content", [b"", b"\x10\x00\x00\x00\x00\x00\x00\x00{", b"not a checkpoint at all"])
def test_a_damaged_checkpoint_is_refused(run, tmp_path, content):
    (tmp_path / "mine.safetensors").write_bytes(content)
    (tmp_path / "mine.json").write_text("{}")
    refused(run("evaluate", "--schedulers", tmp_path / "mine.safetensors", *SHORT), tmp_path / "mine")


@pytest.mark.parametrize("option", ["--json", "--out"])
def test_output_that_cannot_be_written_is_refused_before_the_work(run, tmp_path, option, monkeypatch):
    def never(*_, **__):
        pytest.fail("played although the results cannot be written")

    monkeypatch.setattr("marl_sched.train.evaluation.evaluate.evaluate", never)
    (tmp_path / "file").write_text("")
    command = ("evaluate",) if option == "--json" else ("compare",)
    below_a_file = tmp_path / "file" / "r"
    refused(run(*command, "--schedulers", "condition", *SHORT, option, below_a_file), option, tmp_path / "file")
    assert (tmp_path / "file").read_text() == ""


def test_json_into_a_folder_is_refused(run, tmp_path):
    refused(run("evaluate", "--schedulers", "condition", *SHORT, "--json", tmp_path), "--json", tmp_path)


def test_a_run_that_fails_leaves_an_older_result_as_it_was(run, tmp_path, monkeypatch):
    (tmp_path / "r.json").write_text("old")
    monkeypatch.setattr("json.dumps", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run("evaluate", "--schedulers", "condition", *SHORT, "--json", tmp_path / "r.json")
    assert [path.name for path in tmp_path.iterdir()] == ["r.json"]
    assert (tmp_path / "r.json").read_text() == "old"


@pytest.mark.parametrize(
    ("content", "pieces"),
    [
        ("update,loss\n1,2\n", ["line 2", "'seconds'"]),
        ("seconds,validation\n1,much\n", ["line 2", "numbers", "much"]),
        ("seconds,validation\n1,\n", ["at least one row with a value of 'validation'"]),
    ],
)
def test_a_training_log_that_is_none_is_refused_before_the_work(run, tmp_path, content, pieces):
    (tmp_path / "log.csv").write_text(content)
    out = tmp_path / "out"
    ended = run("compare", "--schedulers", "condition", *SHORT, "--out", out, "--log", tmp_path / "log.csv")
    refused(ended, tmp_path / "log.csv", *pieces)
    assert not out.exists()


@pytest.mark.parametrize(
    ("options", "pieces"),
    [
        (("--policy", "nobody"), ["unknown scheduler 'nobody'"]),
        (("--policy", "condition", "--view", "globe"), ["unknown view of airme 'globe'"]),
        (("--policy", "condition", "--reach", "1"), ["unknown option of airme with view full '--reach'"]),
        (("--policy", "condition", "--scale", "huge"), ["unknown scale of airme 'huge'"]),
        (("--policy", "condition", "--instance", "nowhere.json"), ["nowhere.json"]),
        (("--policy", "condition", "--deadline", "0"), ["deadline"]),
        (("--policy", "condition", "--patience", "0"), ["patience"]),
        (("--policy", "condition", "--agent-policy", "crew_3"), ["AGENT=POLICY", "'crew_3'"]),
        (("--policy", "condition", "--agent-policy", "crew_99=random"), ["'crew_99'", "crew_0"]),
        ((), ["Missing option '--policy'"]),
    ],
)
def test_deploy_refuses(run, options, pieces, tmp_path):
    short = () if "murse" in options else ("--hours", 5)
    refused(run("deploy", *short, *options, "--json", tmp_path / "r.json"), *pieces)
    assert list(tmp_path.iterdir()) == []


def test_a_port_in_use_is_refused(run, tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for command in (("world",), ("deploy", "--policy", "condition", "--insecure")):
            ended = run(*command, "--hours", 5, "--listen", f"tcp/127.0.0.1:{port}", "--json", tmp_path / "r.json")
            refused(ended, port)
    assert list(tmp_path.iterdir()) == []


def test_an_agent_without_a_world_is_refused(run):
    lonely = ("--connect", "tcp/127.0.0.1:1", "--join-timeout", 0.5)
    refused(run("agent", "--agent", 0, "--policy", "condition", *lonely), "tcp/127.0.0.1:1")


def test_a_negative_agent_is_refused(run):
    refused(run("agent", "--agent", -1, "--policy", "condition"), "agent", "-1")


@pytest.mark.parametrize(
    "overrides",
    [
        ["view=globe"],
        ["env=boats"],
        ["updates=many"],
        ["colour=red"],
        ["env.scales=[huge]"],
        ["seed=100000000000000000000000"],
        ["seed=9223372036854775808"],
        ["validation.seed=9223372036854775808"],
        ["policy.width=1000000000"],
    ],
)
def test_train_refuses_a_bad_override(run, tmp_path, overrides):
    refused(run("train", f"run_dir={tmp_path / 'run'}", *overrides))
    assert not (tmp_path / "run").exists()


def test_resume_refuses_a_folder_that_holds_no_run(run, tmp_path):
    refused(run("resume", tmp_path), tmp_path)


def test_demo_refuses_an_unknown_policy_and_writes_nothing(run, tmp_path):
    refused(run("demo", "--policy", "nobody", "--out", tmp_path / "demo"), "unknown scheduler 'nobody'")
    assert not (tmp_path / "demo").exists()


@pytest.mark.parametrize(
    ("module", "extra", "command"),
    [
        ("matplotlib", "plots", ["compare", "--schedulers", "condition", "--out", "unwritten"]),
        ("zenoh", "deploy", ["deploy", "--policy", "condition"]),
        ("torch", "train", ["train"]),
        ("hydra", "train", ["train"]),
        ("torch", "train", ["bench"]),
    ],
)
def test_a_missing_dependency_is_named_with_the_extra_that_brings_it(tmp_path, module, extra, command):
    script = f"import sys; sys.modules[{module!r}] = None; from marl_sched.cli import main; main({command!r})"
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert ended.returncode == 2
    assert ended.stderr == f"error: this needs {module}, which is not installed: pip install 'marl-sched[{extra}]'\n"
    assert list(tmp_path.iterdir()) == []
