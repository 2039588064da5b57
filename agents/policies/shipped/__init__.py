"""Trained policies that ship with the package: NAME.safetensors with its card NAME.json, and nothing else."""
