"""How decisions travel: messages, the world process, agent processes and the launcher."""
