"""Who decides: heuristics, exact solvers and learned policies, all of them schedulers."""
