"""Ctrl-C ends a solver that a command runs, with the exit code of an interrupt."""

import subprocess
import sys

import pytest

# A solver that never ends by itself is interrupted as soon as it works: at its first call, not after a time that a slow
# machine may need to come there. Kernels are loaded first, see tests/agents/murse/test_exact.py.
PROGRAM = """
import os, signal, sys, threading, time
from marl_sched.agents.murse import exact, optimal
from marl_sched.agents.murse.best_rule import best_rule_plan
from marl_sched.agents.murse.problem import Round
from marl_sched.domain import get_domain
from marl_sched.cli import main
best_rule_plan(Round.of(get_domain("murse").instances("small", 1, 0)[0]))
exact.ortools()
run = exact._run
def interrupted(solver, model):
    threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
    return run(solver, model)
exact._run = interrupted
words = "--env murse --scale large --instances 1 --episodes 1 --rounds 1 --schedulers exact --time-limit 3600"
main(["evaluate", *words.split()])
"""


@pytest.mark.slow
def test_an_interrupted_exact_solver_ends_the_command_with_130():
    pytest.importorskip("ortools")
    done = subprocess.run([sys.executable, "-P", "-c", PROGRAM], capture_output=True, text=True, timeout=280)
    assert done.returncode == 130, done.stderr
    assert done.stderr.endswith("interrupted\n")
    assert done.stdout == ""
