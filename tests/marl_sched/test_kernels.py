"""Compiled kernels: an edit anywhere is noticed, and a cache that cannot be used costs time and nothing else."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from marl_sched import kernel_sources

ROOT = Path(__file__).resolve().parents[2]
LOWER = """
from marl_sched.kernels import kernel

@kernel
def lower(x):
    return x + 1
"""
UPPER = """
from marl_sched.kernels import kernel
from probe.lower import lower

@kernel
def upper(x):
    return 10 * lower(x)
"""


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    variables = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env={**variables, **environment}, capture_output=True, text=True, timeout=200)


def write_package(folder: Path) -> Path:
    """A distribution of two modules with kernels, one of which calls the other's."""
    package = folder / "probe"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "lower.py").write_text(LOWER)
    (package / "upper.py").write_text(UPPER)
    (package / "aside.py").write_text("EDITED = 0\n")
    return folder


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    return write_package(tmp_path)


USE = """
import sys
sys.path.insert(0, {folder!r})
from probe.upper import upper
print(upper(1), sum(upper.stats.cache_hits.values()))
"""


def test_an_edit_in_another_file_is_noticed_and_without_one_the_cache_is_used(checkout: Path) -> None:
    code, cache = USE.format(folder=str(checkout)), str(checkout / "cache")
    assert run(code, NUMBA_CACHE_DIR=cache).stdout.split() == ["20", "0"]
    (checkout / "probe" / "aside.py").write_text("EDITED = 1\n")  # nothing that the kernels are made from
    assert run(code, NUMBA_CACHE_DIR=cache).stdout.split() == ["20", "1"]
    (checkout / "probe" / "lower.py").write_text(LOWER.replace("x + 1", "x + 2"))
    assert run(code, NUMBA_CACHE_DIR=cache).stdout.split() == ["30", "0"]


def test_the_same_sources_in_another_place_and_written_later_find_what_is_compiled(checkout: Path) -> None:
    cache, elsewhere = str(checkout / "cache"), checkout / "elsewhere"
    assert run(USE.format(folder=str(checkout)), NUMBA_CACHE_DIR=cache).stdout.split() == ["20", "0"]
    elsewhere.mkdir()
    write_package(elsewhere)
    os.utime(elsewhere / "probe" / "upper.py", (0, 0))
    assert run(USE.format(folder=str(elsewhere)), NUMBA_CACHE_DIR=cache).stdout.split() == ["20", "1"]


def test_settings_that_change_the_code_have_a_cache_of_their_own(checkout: Path) -> None:
    code, cache = USE.format(folder=str(checkout)), str(checkout / "cache")
    assert run(code, NUMBA_CACHE_DIR=cache).stdout.split() == ["20", "0"]
    assert run(code, NUMBA_CACHE_DIR=cache, NUMBA_BOUNDSCHECK="1").stdout.split() == ["20", "0"]
    assert run(code, NUMBA_CACHE_DIR=cache, NUMBA_BOUNDSCHECK="1").stdout.split() == ["20", "1"]


def test_a_module_is_made_from_what_it_imports_and_from_nothing_else() -> None:
    found = kernel_sources.sources("marl_sched.envs.murse.views")
    assert {"marl_sched.envs.murse.views", "marl_sched.envs.murse.instance", "marl_sched.kernels"} <= set(found)
    assert not any("airme" in name or "agents" in name for name in found)
    assert all(path.is_file() for path in found.values())
    assert kernel_sources.sources("builtins") == {}


def test_the_cache_changes_with_a_constant_of_another_module(checkout: Path) -> None:
    code, cache = USE.format(folder=str(checkout)), str(checkout / "cache")
    (checkout / "probe" / "constants.py").write_text("STEP = 1\n")
    lower = LOWER.replace("x + 1", "x + STEP")
    (checkout / "probe" / "lower.py").write_text(f"from probe.constants import (\n    STEP,\n)\n{lower}")
    assert run(code, NUMBA_CACHE_DIR=cache).stdout.split() == ["20", "0"]
    (checkout / "probe" / "constants.py").write_text("STEP = 2\n")
    assert run(code, NUMBA_CACHE_DIR=cache).stdout.split() == ["30", "0"]


@pytest.mark.parametrize("content", [b"", b"no pickle", b"\x80\x04N."])
def test_a_damaged_cache_is_compiled_anew_and_said(checkout: Path, content: bytes) -> None:
    code, cache = USE.format(folder=str(checkout)), checkout / "cache"
    run(code, NUMBA_CACHE_DIR=str(cache))
    for kind in ("*.nbi", "*.nbc"):
        for path in cache.rglob(kind):
            path.write_bytes(content)
    done = run(code, NUMBA_CACHE_DIR=str(cache))
    assert done.stdout.split() == ["20", "0"], done.stderr
    if content != b"\x80\x04N.":  # an index of another version of Numba is no damage
        assert "damaged" in done.stderr


def test_without_a_cache_directory_that_can_be_written_a_private_one_among_temporary_files_serves(
    tmp_path: Path,
) -> None:
    (tmp_path / "file").write_text("")
    code = "from marl_sched.kernels import cache_folder; print(cache_folder())"
    done = run(code, NUMBA_CACHE_DIR=str(tmp_path / "file" / "below"), TMPDIR=str(tmp_path))
    folder = Path(done.stdout.strip())
    assert folder.is_dir()
    assert folder.is_relative_to(tmp_path)
    assert "cannot be kept" in done.stderr
    assert folder.parent.parent.stat().st_mode & 0o077 == 0


def test_a_folder_of_somebody_else_is_not_loaded_from(tmp_path: Path) -> None:
    shared = tmp_path / f"marl_sched-{os.getuid()}"
    shared.mkdir()
    shared.chmod(0o777)
    (tmp_path / "file").write_text("")
    code = "from marl_sched.kernels import cache_folder; print(cache_folder())"
    done = run(code, NUMBA_CACHE_DIR=str(tmp_path / "file" / "below"), TMPDIR=str(tmp_path))
    assert not Path(done.stdout.strip()).is_relative_to(shared)


def test_every_kernel_of_the_package_is_kept_in_its_own_cache() -> None:
    """A kernel of plain Numba with a file cache would keep old code of kernels in other files."""
    rooms = [ROOT / name for name in ("marl_sched", "envs", "agents", "train", "comms")]
    sources = [path for room in rooms for path in room.rglob("*.py") if path.name != "kernels.py"]
    assert sources
    assert [str(path) for path in sources if "cache=True" in path.read_text(encoding="utf-8")] == []


def test_kernels_run_as_plain_python_where_compilation_is_switched_off() -> None:
    code = "from marl_sched.noise import integer; print(integer(0.5, 0, 9))"
    assert run(code, NUMBA_DISABLE_JIT="1").stdout.strip() == "5"
