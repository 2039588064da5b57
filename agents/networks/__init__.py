"""Networks that score decisions: what an architecture must offer, HetGAT, Decima and DeepRM.

Importing this package needs torch; `marl_sched.agents` imports it only when a policy is loaded.
"""
