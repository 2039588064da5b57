"""AirME: maintenance crews and a fleet whose parts fail by chance (dissertation, chapter 6)."""
