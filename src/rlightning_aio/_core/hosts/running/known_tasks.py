"""Gymnasium tasks that are registered in the trainer, for workers that have to make them.

A script registers its tasks when it starts, and workers don't run the script.
"""

from __future__ import annotations

import contextlib
import pickle
from typing import TYPE_CHECKING

import gymnasium as gym

from rlightning_aio.protocol.pickling import dumped_with_code

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from gymnasium.envs.registration import EnvSpec

__all__ = ["known_tasks", "register_tasks"]


def known_tasks() -> tuple[bytes, ...]:
    """Return all registered tasks that can be pickled."""
    return tuple(_pickled(list(gym.registry.values())))


def _pickled(specs: Sequence[EnvSpec]) -> Iterator[bytes]:
    try:
        yield dumped_with_code(specs)
    except Exception:
        if len(specs) > 1:
            for spec in specs:
                yield from _pickled([spec])


def register_tasks(tasks: Sequence[bytes]) -> None:
    """Register the tasks of `known_tasks` that this process lacks and can unpickle."""
    for pickled in tasks:
        with contextlib.suppress(Exception):
            for spec in pickle.loads(pickled):
                gym.registry.setdefault(spec.id, spec)
