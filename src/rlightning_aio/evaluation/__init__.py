"""Evaluating a policy: a fixed set of episodes, and statistics over them.

Rule: it uses only the public `EnvGroup`. The set of episodes is fixed before the first step,
because taking the episodes that end first would favour short ones. It plays the queue of `attempts`
with a policy for all envs at once; `playing` calls it.
"""

from __future__ import annotations

from rlightning_aio.attempts.file import ResultsFile
from rlightning_aio.attempts.spec import EpisodeSpec
from rlightning_aio.evaluation.estimates import Estimate
from rlightning_aio.evaluation.evaluate import evaluate
from rlightning_aio.evaluation.evaluation import Evaluation

__all__ = [
    "EpisodeSpec",
    "Estimate",
    "Evaluation",
    "ResultsFile",
    "evaluate",
]
