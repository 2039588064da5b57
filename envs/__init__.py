"""One folder per scheduling domain, and the environment APIs that every domain gets for free."""

# The domains that ship with the package, the default of the command line first: name -> where it is declared.
# It is imported when it is asked for. Domains of other distributions come by entry points (marl_sched.plugins).
DOMAINS = {
    "airme": "marl_sched.envs.airme.domain:AIRME",
    "murse": "marl_sched.envs.murse.domain:MURSE",
    "ward": "marl_sched.envs.ward.domain:WARD",
}

# Those of them whose agents can do without Numba (marl_sched.light): name -> their light declaration.
LIGHT_DOMAINS = {"airme": "marl_sched.envs.airme.light:AIRME"}
