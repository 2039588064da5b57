"""Schedulers held against each other: evaluation, comparison, plots."""
