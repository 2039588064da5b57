"""Heterogeneous graph attention (HetGAT) on padded dense tensors: layer, encoder, policy and critic networks.

Importing this package needs torch; `marl_sched.agents` imports it only when a policy is loaded.
"""
