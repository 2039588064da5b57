"""Networks that plan whole rounds of MuRSE; they are registered by being here (marl_sched.agents.networks.registry)."""
