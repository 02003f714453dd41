"""Gymnasium's vector interface: a group of envs as a `gymnasium.vector.VectorEnv`.

It replaces `gymnasium.vector.AsyncVectorEnv`: the same arguments, bit-identical results, and the
errors that users of Gymnasium catch. docs/gymnasium.md lists the differences.
"""

from __future__ import annotations

from rlightning_aio.vector.env import VectorEnv
from rlightning_aio.vector.making import make_vec, vector_entry_point

__all__ = ["VectorEnv", "make_vec", "vector_entry_point"]
