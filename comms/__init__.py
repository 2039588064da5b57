"""How decisions travel: messages, the world process, agent processes and the launcher.

A run is a star: the world listens on one TCP endpoint, every agent connects to it. Nothing central decides; the world
is the plant, and its commits are the truth. With no faults a distributed run is bit-equal to the same run in process.

What happens when something fails:

- A message is lost, repeated or late: the turn is sent again every tenth of a second, an agent that lacks a state asks
  for the snapshot, and a decision counts once. Nothing changes but the time it takes.
- A decision misses the deadline: its agent idles for this moment. After `patience` misses in a row it counts as dead.
- An agent's process ends: its liveliness token goes within milliseconds, a turn that is open ends, and the agent idles,
  at no cost in time, until a successor joins. One that freezes or is cut off is noticed within a second the same way.
- A dead agent comes back: its incarnation is fenced, it joins again as another one with the newest snapshot. It
  inherits the misses: one that is slow but alive is given up at once, and for good after twice `patience` in a row.
- The world goes: agents wait `join_timeout` seconds for it to return, then end with an error.
- A message does not parse, or its sender is not who it says: it is counted, logged and dropped.
- The launcher ends, in whatever way: the pipe that every child holds breaks, and the child ends.
"""
