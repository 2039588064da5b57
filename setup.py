"""Finds the packages: `marl_sched`, and the rooms beside it as its sub-packages (the rest is in pyproject.toml)."""

from setuptools import find_packages, setup

ROOMS = ("envs", "agents", "train", "comms", "configs")

# In a checkout `marl_sched/envs` and the others are links to the rooms: editors and mypy find the package by them.
packages = find_packages(include=["marl_sched", "marl_sched.*"], exclude=[f"marl_sched.{room}*" for room in ROOMS])
for room in ROOMS:
    packages += [f"marl_sched.{package}" for package in find_packages(include=[room, f"{room}.*"])]

setup(packages=packages, package_dir={f"marl_sched.{room}": room for room in ROOMS})
