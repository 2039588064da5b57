"""Learned policies whatever their architecture: what a network must offer, how it decides, how it is kept in files.

Decima and DeepRM are here too; HetGAT, which is larger, has a package of its own. Importing this package needs torch;
`marl_sched.agents` imports it only when a policy is loaded.
"""
