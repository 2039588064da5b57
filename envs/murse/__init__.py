"""MuRSE: teams of robots and of humans who learn, under temporal and spatial constraints (chapters 3 to 5)."""
