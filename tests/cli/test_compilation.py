"""What a user hears while kernels are compiled for the first time."""

from __future__ import annotations

import numba
import pytest

from marl_sched.cli.compilation import told_of_compilation


def compile_two() -> None:
    """Compile a kernel that calls another one."""

    @numba.njit
    def inner(x: int) -> int:
        return x + 1

    @numba.njit
    def outer(x: int) -> int:
        return inner(x) + 1

    assert outer(1) == 3


def test_compilation_is_announced_and_its_length_told(capsys: pytest.CaptureFixture[str]) -> None:
    with told_of_compilation(patience=0.0):
        compile_two()
    announced, length = capsys.readouterr().err.splitlines()
    assert announced.startswith("compiling the simulator: a minute or so, once")
    assert length.startswith("compiled 2 kernels in ")


def test_nothing_is_said_of_what_is_compiled_already_or_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    with told_of_compilation(patience=1e9):
        compile_two()
    with told_of_compilation(patience=0.0):
        pass
    assert capsys.readouterr().err == ""
