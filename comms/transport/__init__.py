"""How bytes travel: the interface that drivers use, Zenoh behind it, and endpoints."""
