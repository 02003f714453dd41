"""Corrupted messages for both ends, while requests between them must still be answered."""

from __future__ import annotations

import tracemalloc
from collections import deque
from dataclasses import dataclass

import numpy as np
from remote.random_spaces import mutation
from remote.unreliable import World

from rlightning_aio.protocol.net.wire import ClientHello, Writer

_KEPT = 200


@dataclass
class Findings:
    """Results of a run.

    Attributes:
        frames: corrupted messages that were delivered.
        steps: steps that were answered.
        grown: bytes by which memory grew over the second half.
    """

    frames: int = 0
    steps: int = 0
    grown: int = 0


def fuzz(frames: int, seed: int) -> Findings:
    """Deliver `frames` corrupted messages to each end; step a client after every fiftieth."""
    rng = np.random.default_rng(seed)
    world = World()
    world.join_all()
    seen = {True: deque[list[bytes]](maxlen=_KEPT), False: deque[list[bytes]](maxlen=_KEPT)}
    findings = Findings()
    tracemalloc.start()
    try:
        held = 0
        while findings.frames < frames:
            name = "ab"[findings.frames % 2]
            step(world, name, findings)
            for (_, to_server), said in world.delivered.items():
                seen[to_server].extend(said)
            world.delivered.clear()
            for client in world.clients.values():
                # The test's own records, which would count as growth.
                client.executed.clear()
                client.ended.clear()
                client.refused.clear()
            for _ in range(25):
                spoil(world, name, seen, rng)
                findings.frames += 1
            if not held and findings.frames >= frames // 2:
                held = tracemalloc.get_traced_memory()[0]
        findings.grown = tracemalloc.get_traced_memory()[0] - held
    finally:
        tracemalloc.stop()
    return findings


def hello(rng: np.random.Generator) -> list[bytes]:
    """Return a hello that is valid but for its version."""
    space = {"type": "discrete", "n": 2**62, "start": 2**62}
    return Writer().write(
        ClientHello(
            version=int(rng.integers(0, 4)),
            name=f"peer-{rng.integers(100)}",
            observation_space=space,
            action_space=space,
        )
    )


def spoil(
    world: World, name: str, seen: dict[bool, deque[list[bytes]]], rng: np.random.Generator
) -> None:
    """Deliver one corrupted message to each end."""
    client = world.clients[name]
    for to_server, said in seen.items():
        # The last message is seldom a hello.
        is_hello = to_server and rng.random() < 0.2
        whole = hello(rng) if is_hello else said[int(rng.integers(len(said)))]
        parts = mutation(rng)(whole)
        if to_server:
            world.server.receive(client.route or b"%s:-" % name.encode(), parts)
            world.flush()
        elif client.route is not None:
            client.receive(parts)
    world.join_all()
    world.take()


def step(world: World, name: str, findings: Findings) -> None:
    """Reset the client, which may have lost its session but must come back and serve."""
    for _ in range(200):
        world.join_all()
        if world.place_of(name) is not None:
            break
    else:
        raise AssertionError(f"{name} never came back")
    world.take()
    world.reset(name)
    world.settle()
    assert world.take(), f"{name} never answered"
    findings.steps += 1
