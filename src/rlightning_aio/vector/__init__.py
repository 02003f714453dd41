"""Gymnasium's vector interface: a group of envs as a `gymnasium.vector.VectorEnv`.

It takes the place of `gymnasium.vector.AsyncVectorEnv`: the same arguments, the same results to the
bit, the same errors where Gymnasium's users catch them. docs/gymnasium.md tells what differs.
"""

from __future__ import annotations

from rlightning_aio.vector.env import VectorEnv
from rlightning_aio.vector.making import make_vec, vector_entry_point

__all__ = ["VectorEnv", "make_vec", "vector_entry_point"]
