"""Policies of commands: by import path, from files of Stable-Baselines3, or random, with masks."""
