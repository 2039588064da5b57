"""Which process decides for which agent: slots, their states, and the table of transitions."""
