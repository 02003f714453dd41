"""Groups of attempts: agents that are coroutines play each task several times.

Rule: it uses only the public `EnvGroup`. An attempt that fails has no reward, but an `Outcome`.
`queue` decides which env plays what next; `evaluation` plays the same queue with a policy in place
of an agent.
"""

from __future__ import annotations

from rlightning_aio.attempts.episode import AttemptEpisode
from rlightning_aio.attempts.file import ResultsFile
from rlightning_aio.attempts.playing import play
from rlightning_aio.attempts.records import Attempt, AttemptGroup
from rlightning_aio.attempts.rules import Rules
from rlightning_aio.attempts.spec import EpisodeSpec

__all__ = [
    "Attempt",
    "AttemptEpisode",
    "AttemptGroup",
    "EpisodeSpec",
    "ResultsFile",
    "Rules",
    "play",
]
