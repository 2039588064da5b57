"""Learned policies whatever their architecture: what a network must offer, and two published ones beside HetGAT.

Importing this package needs torch; `marl_sched.agents` imports it only when a policy is loaded.
"""
