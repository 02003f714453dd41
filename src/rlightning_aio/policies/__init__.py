"""Policies for `evaluate`: action chunks, models with a `predict`, clients of policy servers.

Rule: a policy is called with a batch of results and returns one action for each, and whatever it
keeps between calls belongs to one env's episode and ends with it. Clients speak over WebSockets
and unpickle nothing.
"""

from __future__ import annotations

from rlightning_aio.policies.chunks import ActionChunks
from rlightning_aio.policies.predicting import PredictPolicy

__all__ = ["ActionChunks", "PredictPolicy"]
