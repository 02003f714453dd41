"""Evaluating a policy: equally many episodes of each env, and what they say of it.

Rule: it stands on the public `EnvGroup` alone. To take the episodes that end first would favour
envs, and outcomes, that end soon.
"""

from __future__ import annotations

from rlightning_aio.evaluation.episodes import Episode, Evaluation
from rlightning_aio.evaluation.estimates import Estimate
from rlightning_aio.evaluation.evaluate import evaluate

__all__ = ["Episode", "Estimate", "Evaluation", "evaluate"]
