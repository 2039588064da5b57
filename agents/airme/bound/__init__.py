"""What the best conceivable scheduler of AirME could reach, and a scheduler that comes close to it."""
