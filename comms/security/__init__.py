"""Certificates of a run's processes, and what each of them may say and hear."""
