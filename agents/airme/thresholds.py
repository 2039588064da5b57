"""The thresholds of AirME's rules (dissertation, section 6.5.1), which compiled and light rules share."""

from __future__ import annotations

FIRST = 1e9  # added to the rank of planes that go before all others
PERIOD = 6  # hours, periodic
HOURS = 40.0  # operating hours, condition
FAILURE = 0.004  # probability, model-based
PREVENTIVE_HOURS, PREVENTIVE_LANDINGS = 45.0, 4.0  # preventive-first
