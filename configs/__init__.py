"""Hydra configuration, found as `pkg://marl_sched.configs`."""
