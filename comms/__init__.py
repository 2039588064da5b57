"""How decisions travel: the protocol, the world process, agent processes and the launcher.

A run is a star: the world listens on one endpoint, every agent connects to it. Nothing central decides; the world
is the plant, and its commits are the truth. With no faults a distributed run is bit-equal to the same run in process.

The protocol is written down in `comms/PROTOCOL.md`, where every failure has a number and a test, and is pure code in
`protocol/` and `membership/`: `handle(event, now) -> effects`, with no clock, thread or socket. `world.py` and
`agent.py` drive it by a clock and a network: Zenoh (`transport/`), or one in memory (`inproc.py`), with which a whole
deployment runs in one process. `launcher.py` starts and restarts processes, which are forked from `fork_server.py`;
`decision_log.py` keeps what was decided; `security/` makes certificates and says who may say and hear what;
`metrics/` counts and reports. `dashboard/` shows a running deployment, `chaos/` lets faults and attacks happen to one.
"""
