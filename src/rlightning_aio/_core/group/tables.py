"""`Tables`: the state of a group, which its parts share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rlightning_aio._core.group.episodes.continuity import Continuity
    from rlightning_aio._core.group.state.conditions import Conditions
    from rlightning_aio._core.group.state.env_table import EnvTable
    from rlightning_aio._core.group.state.lifetime import Lifetime
    from rlightning_aio._core.group.state.observed import Observed
    from rlightning_aio._core.group.state.requests import Requests
    from rlightning_aio._core.group.state.slab_layout import SlabLayout

__all__ = ["Tables"]


@dataclass(frozen=True)
class Tables:
    """The state of a group, which knows no hosts.

    Attributes:
        envs, requests, layout, continuity: tables over the slots.
        conditions: the reasons why a step can't take the fast path.
        observed: holds the observer.
        lifetime: whether the group is open.
    """

    envs: EnvTable
    requests: Requests
    layout: SlabLayout
    continuity: Continuity
    conditions: Conditions
    observed: Observed
    lifetime: Lifetime
