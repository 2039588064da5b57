"""The protocol as pure code: messages, keys, and what world and agents do on every event; see comms/PROTOCOL.md."""
