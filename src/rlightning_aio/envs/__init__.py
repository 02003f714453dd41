"""Envs: the base classes, and an adapter for each simulator.

`base` is what authors derive from, `state` saves their envs. The folders are `simulators` (one
module each), `mujoco` (many simulations stepped together) and `adapted` (around the envs of
callables). Nothing here knows workers or groups.
"""
