"""`python -m marl_sched.cli`."""

from marl_sched.cli import main

main()
