import errno
import json
import os
import re
import stat
import subprocess
import sys

import pytest

from marl_sched.errors import InvalidFileError
from marl_sched.files import read_json, replacing, write_json


def fail_halfway(action):
    with replacing(action) as temporary:
        temporary.write_text('{"half": ')
        raise RuntimeError("halfway")


def test_json_comes_back_as_it_was_written(tmp_path):
    data = {"name": "Flügel", "income": [1.5, 2], "broken": False, "none": None}
    write_json(tmp_path / "a.json", data)
    assert read_json(tmp_path / "a.json") == data


def test_missing_folders_are_made(tmp_path):
    write_json(tmp_path / "deep" / "er" / "a.json", 1)
    assert read_json(tmp_path / "deep" / "er" / "a.json") == 1


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    action = tmp_path / "a.json"
    write_json(action, "old")
    with pytest.raises(RuntimeError, match="halfway"):
        fail_halfway(action)
    assert read_json(action) == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_target_is_untouched_until_the_block_ends(tmp_path):
    action = tmp_path / "a.txt"
    action.write_text("old")
    with replacing(action) as temporary:
        temporary.write_text("new")
        assert action.read_text() == "old"
        assert temporary.parent == tmp_path  # a rename never crosses file systems
    assert action.read_text() == "new"


@pytest.mark.parametrize("value", [float("nan"), float("inf"), {1, 2}])
def test_what_is_not_json_is_refused_and_nothing_is_written(tmp_path, value):
    with pytest.raises((ValueError, TypeError)):
        write_json(tmp_path / "a.json", [1, value])
    assert list(tmp_path.iterdir()) == []


def test_new_file_has_the_permissions_that_the_umask_grants(tmp_path):
    before = os.umask(0o027)
    try:
        write_json(tmp_path / "a.json", 1)
        assert os.umask(0o027) == 0o027
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == 0o640


def test_missing_file_is_named(tmp_path):
    with pytest.raises(InvalidFileError, match=r"gone\.json: expected a readable file \(No such file or directory\)"):
        read_json(tmp_path / "gone.json")


def test_folder_is_no_file(tmp_path):
    with pytest.raises(InvalidFileError, match=r"expected a readable file \(Is a directory\)"):
        read_json(tmp_path)


def test_malformed_json_is_located(tmp_path):
    path = tmp_path / "bad.json"
    path.write_text('{"a": 1,\n "b": }')
    with pytest.raises(InvalidFileError, match=r"bad\.json: line 2 column 7: expected valid JSON"):
        read_json(path)


def test_truncated_file_is_located(tmp_path):
    path = tmp_path / "short.json"
    path.write_text(json.dumps({"planes": [1, 2, 3]})[:-3])
    with pytest.raises(InvalidFileError, match=r"short\.json: line 1 column \d+: expected valid JSON"):
        read_json(path)


def test_bytes_that_are_no_text_are_located(tmp_path):
    path = tmp_path / "latin.json"
    path.write_bytes(b'{"name": "Fl\xfcgel"}')
    with pytest.raises(InvalidFileError, match=r"latin\.json: byte 12: expected UTF-8 text"):
        read_json(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[" * 100_000 + "]" * 100_000, "expected JSON that is not nested so deeply"),
        ('{"a":' * 100_000 + "1" + "}" * 100_000, "expected JSON that is not nested so deeply"),
        ("9" * 5000, r"expected valid JSON \(Exceeds the limit \(4300 digits\)"),
        ("[1, NaN]", r"expected valid JSON \(NaN is none of its numbers\)"),
        ("[Infinity]", r"expected valid JSON \(Infinity is none"),
        ("[-Infinity]", r"expected valid JSON \(-Infinity is none"),
    ],
)
def test_what_python_reads_differently_from_json_or_not_at_all_is_refused(tmp_path, content, message):
    path = tmp_path / "odd.json"
    path.write_text(content)
    with pytest.raises(InvalidFileError, match=rf"odd\.json: {message}"):
        read_json(path)


def test_a_key_that_an_object_has_twice_is_refused(tmp_path):
    path = tmp_path / "twice.json"
    path.write_text('{"planes": [{"hours": 1, "hours": 2}]}')
    with pytest.raises(InvalidFileError, match=r"twice\.json: hours: expected a key .* once, got \(1, 2\)"):
        read_json(path)


def test_a_device_is_written_to_and_stays_a_device():
    before = os.stat("/dev/null")
    write_json("/dev/null", {"a": 1})
    after = os.stat("/dev/null")
    assert stat.S_ISCHR(after.st_mode)
    assert (after.st_ino, after.st_rdev) == (before.st_ino, before.st_rdev)


def test_a_device_elsewhere_is_written_through_too(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_json(pipe, [1])
        assert os.read(reader, 100) == b"[\n  1\n]\n"
        assert stat.S_ISFIFO(pipe.stat().st_mode)
    finally:
        os.close(reader)
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"]


def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path):
    (tmp_path / "there").mkdir()
    real, link, dangling = tmp_path / "there" / "real.json", tmp_path / "link.json", tmp_path / "new.json"
    real.write_text("old")
    link.symlink_to(real)
    dangling.symlink_to(tmp_path / "there" / "made.json")
    write_json(link, 1)
    write_json(dangling, 2)
    assert link.is_symlink()
    assert dangling.is_symlink()
    assert (read_json(real), read_json(tmp_path / "there" / "made.json")) == (1, 2)


def test_standard_output_keeps_what_was_printed_before(tmp_path):
    """`--json /dev/stdout > file`: the file is the same one, with the JSON behind the rest."""
    program = (
        "import sys; from marl_sched.files import write_json; print('before', flush=True); "
        "write_json('/dev/stdout', [1]); write_json('-', [2])"
    )
    out = tmp_path / "out"
    with out.open("w") as file:
        subprocess.run([sys.executable, "-c", program], stdout=file, check=True)
    assert out.read_text().split() == ["before", "[", "1", "]", "[", "2", "]"]
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["before", "[", "1", "]", "[", "2", "]"]


def test_a_file_keeps_its_permissions(tmp_path):
    path = tmp_path / "secret.json"
    write_json(path, 1)
    path.chmod(0o600)
    write_json(path, 2)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_full_disk_is_an_error_that_names_the_file(tmp_path):
    with pytest.raises(OSError, match=re.escape(f"[Errno {errno.ENOSPC}]")) as caught:
        write_json("/dev/full", [1])
    assert caught.value.filename == "/dev/full"

    def full(target):
        with replacing(target):
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left") as caught:
        full(tmp_path / "a.json")
    assert caught.value.filename == str(tmp_path / "a.json")
    assert list(tmp_path.iterdir()) == []
