"""Colours of MuRSE's pictures."""

ROBOT, HUMAN, LATE, WAIT = "#56a0d3", "#f4b040", "#cb4335", "#7f8c8d"
