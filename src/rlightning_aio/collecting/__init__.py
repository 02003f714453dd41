"""Collecting for training: between a group and a learner.

`Collector` steps a group with a policy and gives out `Rollout`s: transitions as columns, each
env's in order, with what is needed to bootstrap from at every end, and advantages over them.
Rule: it stands on the public `EnvGroup` alone, and on NumPy; torch shares the arrays.
"""

from __future__ import annotations

from rlightning_aio.collecting.advantages import VTrace
from rlightning_aio.collecting.collector import Collector
from rlightning_aio.collecting.record import Record, RecordedGroup, ReplayedGroup
from rlightning_aio.collecting.rollout import Lag, Rollout, Seconds

__all__ = [
    "Collector",
    "Lag",
    "Record",
    "RecordedGroup",
    "ReplayedGroup",
    "Rollout",
    "Seconds",
    "VTrace",
]
