"""Rules, index policy and upper bound of AirME."""
