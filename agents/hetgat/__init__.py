"""Heterogeneous graph attention (HetGAT) on padded dense tensors: layer, networks and the policy that acts.

Importing this package needs torch; `marl_sched.agents` imports it only when a policy is loaded.
"""
