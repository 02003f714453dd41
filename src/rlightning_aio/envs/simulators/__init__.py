"""An adapter for each simulator and library of envs.

Each module imports its simulator where an env is built, never before, because the registry names
them all. What they share is in `envs.base` and `envs.wrappers`.
"""
