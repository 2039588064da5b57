"""Trained policies: how a network decides, its card, its files, and those that ship with the package."""
