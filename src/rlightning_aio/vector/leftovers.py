"""Outstanding requests of a call that failed or timed out."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from rlightning_aio.calling import await_cancelled, collect_calls
from rlightning_aio.errors import EnvFault, NothingPending

if TYPE_CHECKING:
    from rlightning_aio.sync import EnvGroup

__all__ = ["drop_outstanding"]


def drop_outstanding(group: EnvGroup) -> None:
    """Wait until no env is busy, and discard all results and faults."""
    for collect in (group.collect_async, partial(collect_calls, group)):
        while True:
            try:
                collect()
            except NothingPending:
                break
            except EnvFault:
                continue
    await_cancelled(group)
