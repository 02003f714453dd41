"""Collecting for training: the layer between a group and a learner.

`Collector` steps a group with a policy and returns `Rollout`s: transitions as columns, ordered by
env, with the observations needed to bootstrap at each end, and advantages over them. `collector`
calls the policy, `kind` and `staging` fill the columns.
Rule: it uses only the public `EnvGroup` and NumPy; torch shares the arrays.
"""

from __future__ import annotations

from rlightning_aio.collecting.collector import Collector
from rlightning_aio.collecting.rollout import Rollout

__all__ = ["Collector", "Rollout"]
