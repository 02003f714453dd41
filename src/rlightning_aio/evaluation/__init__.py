"""Evaluating a policy: a fixed set of episodes, and statistics over them.

Rule: it uses only the public `EnvGroup`. Either each env plays a fixed number of episodes, or the
envs share a queue of episodes. Both sets are fixed before the first step, because taking the
episodes that end first would favour short ones.
"""

from __future__ import annotations

from rlightning_aio.attempts.spec import EpisodeSpec
from rlightning_aio.evaluation.episode_video import EpisodeVideo
from rlightning_aio.evaluation.episodes import Episode, Evaluation
from rlightning_aio.evaluation.estimates import Estimate
from rlightning_aio.evaluation.evaluate import evaluate
from rlightning_aio.evaluation.records import EpisodeRecord, QueueEvaluation
from rlightning_aio.evaluation.results_file import ResultsFile

__all__ = [
    "Episode",
    "EpisodeRecord",
    "EpisodeSpec",
    "EpisodeVideo",
    "Estimate",
    "Evaluation",
    "QueueEvaluation",
    "ResultsFile",
    "evaluate",
]
