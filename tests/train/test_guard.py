"""A run's folder belongs to one process, and an interrupted run leaves a checkpoint of its last update."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from marl_sched.errors import InvalidOptionError
from marl_sched.train.guard import exclusive, stopping

HOLD = """
import sys
from pathlib import Path
from marl_sched.train.guard import exclusive
with exclusive(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def hold(folder: Path) -> subprocess.Popen[str]:
    """A process that holds a folder until its input is closed."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_a_folder_that_another_process_holds_is_refused_until_that_process_ends(tmp_path):
    with hold(tmp_path / "run") as process:
        with (
            pytest.raises(InvalidOptionError, match=r"run_dir: another process trains in .*run"),
            exclusive(tmp_path / "run"),
        ):
            pass
        process.kill()
    with exclusive(tmp_path / "run"):
        pass


def test_training_into_a_folder_in_use_changes_nothing_there(tmp_path):
    pytest.importorskip("torchrl")
    from marl_sched.train.run import train_from_overrides

    folder = tmp_path / "run"
    with hold(folder) as process:
        with pytest.raises(InvalidOptionError, match="another process trains"):
            train_from_overrides(["env=airme", f"run_dir={folder}"], quiet=True)
        process.kill()
    assert [path.name for path in folder.iterdir()] == [".lock"]


@pytest.mark.parametrize(("number", "ends"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)])
def test_the_first_signal_is_noted_and_ends_the_process_only_when_it_leaves(number, ends, capsys):
    before = signal.getsignal(number)
    with stopping() as stop:
        assert not stop.requested
        os.kill(os.getpid(), number)
        assert stop.requested
        assert signal.getsignal(number) == before  # the second one ends at once
    with pytest.raises(ends) as caught:
        stop.leave("go on by resume")
    if ends is SystemExit:
        assert caught.value.code == 143
    assert capsys.readouterr().err.endswith("go on by resume\n")


def test_without_a_signal_nothing_ends_and_the_handlers_are_those_of_before():
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with stopping() as stop:
        pass
    stop.leave("not said")
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_another_thread_than_the_main_one_notes_nothing():
    seen = []

    def work():
        with stopping() as stop:
            seen.append(stop.requested)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]


def test_an_interrupted_run_is_saved_at_its_last_update_and_resumes_as_if_it_had_not_stopped(tmp_path, monkeypatch):
    """Updates are saved every second one: the third would be lost without the checkpoint made at the end."""
    pytest.importorskip("torchrl")
    from marl_sched.files import read_json
    from marl_sched.train.logging import RunLog
    from marl_sched.train.run import resume, train_from_overrides
    from tests.train.test_run import GAE, checkpoint

    whole = train_from_overrides([*GAE, f"run_dir={tmp_path / 'whole'}"], quiet=True)
    original = RunLog.on_update

    def interrupted(self, run, values):
        original(self, run, values)
        if values["update"] == 3:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(RunLog, "on_update", interrupted)
    with pytest.raises(SystemExit):
        train_from_overrides([*GAE, f"run_dir={tmp_path / 'stopped'}"], quiet=True)
    monkeypatch.undo()
    assert read_json(tmp_path / "stopped" / "checkpoint.json")["counters"]["update"] == 3
    resumed = checkpoint(resume(tmp_path / "stopped", quiet=True))
    for name, array in checkpoint(whole).items():
        assert (resumed[name] == array).all()
