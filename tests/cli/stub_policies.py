"""Policies that tests name on the command line; they note what they were given."""

from __future__ import annotations

import asyncio
from typing import Any

furthest_seen: list[int] = []
names_seen: list[frozenset[str]] = []

not_callable = 3


def furthest(batch: Any) -> list[int]:
    """Notes the highest step count that the stub envs of a batch have observed."""
    furthest_seen.append(int(batch.observation.max()))
    return [0] * len(batch)


def names(batch: Any) -> list[int]:
    """Notes whose results come at once, and that they stack."""
    assert len(batch.observation) == len(batch)
    names_seen.append(frozenset(id_.partition("-")[0] for id_ in batch.ids()))
    return [0] * len(batch)


def respond(batch: Any) -> Any:
    """Attaches something to its actions."""
    return batch.respond(action=[1] * len(batch), value=[0.5] * len(batch))


async def later(batch: Any) -> list[int]:
    """Takes its time, as one that asks a server does."""
    await asyncio.sleep(0)
    return [1] * len(batch)


def too_few(batch: Any) -> list[int]:
    """Forgets an env."""
    return [0] * (len(batch) - 1)


def broken(batch: Any) -> list[int]:
    """Fails."""
    raise LookupError("no such weights")


print("policies that print when they are imported")  # noqa: T201
