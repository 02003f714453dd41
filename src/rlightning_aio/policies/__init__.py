"""Policies, and what they may return; action chunks, and models with a `predict`.

Rule: a policy is called with a batch of results and returns one action for each, and whatever it
keeps between calls belongs to one env's episode and ends with it.
"""

from __future__ import annotations

from rlightning_aio.policies.chunks import ActionChunks

__all__ = ["ActionChunks"]
