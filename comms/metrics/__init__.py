"""What is counted and reported of a run, in bounded memory."""
