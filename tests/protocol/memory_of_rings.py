"""Rings and bell of a group over plain memory."""

from __future__ import annotations

from rlightning_aio.protocol.rings import (
    TrainerBell,
    TrainerRings,
    WorkerBell,
    WorkerRings,
    bell_size,
    rings_size,
)


def both_sides(
    num_envs: int, memory: memoryview | None = None
) -> tuple[TrainerBell, TrainerRings, WorkerRings]:
    """The trainer's side and the worker's, for a group of one worker.

    Args:
        num_envs: of the worker.
        memory: `memory_size` zeroed bytes; None for some of this process.
    """
    if memory is None:
        memory = memoryview(bytearray(memory_size(num_envs)))
    ring, rings = memory[: bell_size(1)], memory[bell_size(1) :]
    bell = TrainerBell(ring, 1)
    trainer = TrainerRings(rings, num_envs, bell, 0)
    return bell, trainer, WorkerRings(rings, num_envs, WorkerBell(ring, 1, 0))


def unused(*arguments: object) -> None:
    """Stand in for a function of the worker that a test has no use for."""
    del arguments


def memory_size(num_envs: int) -> int:
    """Size in bytes for a group of one worker."""
    return bell_size(1) + rings_size(num_envs)
