"""MuRSE: human-robot teams that schedule tasks under deadlines, waits and separation, round after round."""
