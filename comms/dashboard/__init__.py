"""Looking at a running deployment without touching it: in a terminal, or in a browser on this machine.

`watcher.py` subscribes to what the world tells observers; `terminal.py` and `web.py` show it. With certificates an
observer has no right to say anything.
"""
