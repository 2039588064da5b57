"""Schedulers of the delivery ward."""
