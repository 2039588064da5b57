"""Scripted faults and attacks against real processes, and the invariants that must hold all the same.

`campaign.py` runs cases (`cases.py`) and makes the table; `scene.py` is a deployment that is watched; `audit.py` holds
the run's log against the invariants of PROTOCOL.md; `proxy.py` is a link that can be cut or slowed; `intruder.py` is a
process that attacks.
"""
