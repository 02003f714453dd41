"""Compares the results of an env with its requests, and decides if they can be true.

An env's results are followed through its lives, episodes and steps; `witness` describes how they
identify themselves. This module knows no group: it takes rows, and raises `Lie`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from witness import (
    BLOB_BYTES,
    CHECK,
    EPISODE,
    INDEX,
    LIFE,
    NAMES,
    PARENT,
    PID,
    STEPS,
    TOKEN,
    checksum,
    extra_info,
)

RAISING = tuple(name for name in NAMES if name.startswith("raise"))
DYING = ("exit", "crash")
HANGING = ("sleep", "compute", "deadlock", "stop itself", "close descriptors")
AWAITING = ("await forever", "ignore cancellation")
"""An awaitable env does not finish its step; its event loop continues."""
# A process that has stopped itself may have been continued.
ENDLESS = {*RAISING, *DYING, *HANGING, *AWAITING} - {"stop itself"}


class Lie(Exception):
    """A result contradicts its request."""


def lie(wrong: Any, what: str, *details: Any) -> None:
    """Raise `Lie` if a condition is true."""
    if wrong:
        raise Lie(f"{what} {details or ''}")


@dataclass
class Request:
    """A request to an env that has not ended.

    Attributes:
        to_collector: `collect_async` will return the reply.
        given_up: its call may have been cancelled.
        is_due: it was a step that `auto_reset` replaces by a reset.
    """

    kind: str
    since: float
    token: float = 0.0
    fault: str = "nothing"
    seed: int = -1
    to_collector: bool = True
    given_up: bool = False
    is_due: bool = False


@dataclass
class Env:
    """What has been observed of an env, and the request that it owes.

    Attributes:
        place: ``process``, ``inline``, ``loop`` or ``client``.
        brittle: its worker is not replaced.
        awaitable: it shares an event loop, that of a worker or of the trainer.
        lives: its previous lives.
        limbo: the time since when a cancelled call may keep it busy.
        gone: it only raises from now on.
        due: `auto_reset` will reset it in place of its next step.
        count: number of steps, for the step limit.
    """

    env_id: str
    index: int
    place: str
    layout: str
    brittle: bool = False
    awaitable: bool = False
    life: float = 0.0
    pid: int = 0
    parent: int = 0
    episode: int = 0
    steps: int = 0
    request: Request | None = None
    limbo: float | None = None
    gone: bool = False
    due: bool = False
    count: int = 0
    lives: set[float] = field(default_factory=set, repr=False)

    @property
    def idle(self) -> bool:
        """Return True if it can get a request."""
        return self.request is None and self.limbo is None and not self.gone

    def note(self, row: Row) -> None:
        """Record its current position."""
        seen = row.named
        if self.life and seen[LIFE] != self.life:
            self.lives.add(self.life)
        self.life, self.pid, self.parent = float(seen[LIFE]), int(seen[PID]), int(seen[PARENT])
        self.episode, self.steps = row.now

    def begin_count(self) -> None:
        """Count its steps from here."""
        self.due, self.count = False, 0


@dataclass
class Row:
    """The parts of one result; `now` is its episode and step."""

    named: np.ndarray
    reward: float
    terminated: bool
    truncated: bool
    is_reset: bool
    restarted: bool
    limit: bool
    info: dict[str, Any]

    @property
    def now(self) -> tuple[int, int]:
        """Return its episode and step."""
        return int(self.named[EPISODE]), int(self.named[STEPS])


def judge(env: Env, request: Request | None, row: Row, limit: int | None) -> str:
    """Decide how a result ends a request; record the env's new position in `env`.

    Args:
        env: its last known position.
        request: the one that it owes, if any.
        row: the result.
        limit: of `auto_reset`, if that is on.

    Raises:
        Lie: the result can't be true.
    """
    seen = row.named
    lie(seen[CHECK] != checksum(seen), "a row of two halves")
    lie(seen[INDEX] != env.index, "another env's data")
    lie(seen[LIFE] in env.lives, "a life that was over")
    if not (row.restarted and env.place == "client"):
        names = {k: row.info.get(k) for k in ("index", "life", "episode", "steps", "token")}
        expected = {
            "index": env.index, "life": seen[LIFE], "episode": seen[EPISODE],
            "steps": seen[STEPS], "token": seen[TOKEN],
        }  # fmt: skip
        lie(names != expected, "another step's info", expected)
    if env.place == "client":
        return _judge_client(env, request, row)
    if request is None:
        raise Lie("nothing was asked")
    if row.restarted:
        return _judge_marked(env, row)
    return _judge_local(env, request, row, limit)


def _judge_marked(env: Env, row: Row) -> str:
    lie(env.place == "inline", "an env in the trainer's process was replaced")
    lie(env.brittle, "what is not to be replaced was")
    lie(not row.info.get("worker_restarted"), "no cause")
    _check_marks(row)
    lie(row.named[LIFE] == env.life, "marked, and still alive")
    lie(row.now != (1, 0) or row.named[TOKEN] != 0, "not the first reset of a life")
    env.note(row)
    env.begin_count()
    return "marked"


def _check_marks(row: Row) -> None:
    lie(not row.is_reset or not row.truncated or row.terminated, "not marked in all ways")
    lie(row.reward != 0 or row.limit, "a reward, or a limit")


def _judge_local(env: Env, request: Request, row: Row, limit: int | None) -> str:
    lie("worker_restarted" in row.info, "a cause without a mark")
    lie(row.truncated, "truncated, and not marked")
    new, before = row.named[LIFE] != env.life, (env.episode, env.steps)
    env.note(row)
    if request.kind == "reset" or request.is_due:
        lie(not row.is_reset or row.terminated or row.limit, "not a plain reset")
        lie(row.reward != 0 or row.named[TOKEN] != 0, "the answer to a step")
        lie(row.info.get("seed") != request.seed, "another seed")
        # A death without a request is reported by a step, but not by a reset.
        lie(new and request.kind != "reset", "a new life, and not marked")
        here = env.place in ("inline", "loop")
        lie(new and here and before[0], "a new life in the trainer's process")
        lie(row.now != (1 if new else before[0] + 1, 0), "not that reset", before)
        env.begin_count()
        return "reset" if request.kind == "reset" else "reset in place of a step"
    lie(new, "a new life, and not marked")
    lie(row.is_reset, "a reset, and a step was due")
    lie(row.now != (before[0], before[1] + 1), "not the next step", before)
    lie(request.fault in ENDLESS, "a result where there can be none")
    _judge_step(request, row)
    env.count += 1
    cut = limit is not None and env.count >= limit
    lie(row.limit != cut, "limit_reached is wrong", limit)
    env.due = limit is not None and (row.terminated or cut)
    return "step"


def _judge_step(request: Request, row: Row) -> None:
    lie(row.named[TOKEN] != request.token, "the answer to another request")
    lie(row.reward != request.token, "another step's reward")
    lie(row.terminated != (request.fault == "end"), "terminated, or not")
    extra = extra_info(request.fault, request.token)
    if "blob" in extra:
        found = row.info.get("blob", b"")
        lie(len(found) != BLOB_BYTES or found != extra["blob"], "another big info")
    elif extra:
        nested, wanted = dict(row.info.get("nested", {})), dict(extra["nested"])
        alike = np.array_equal(nested.pop("array", None), wanted.pop("array"))
        lie(not alike or nested != wanted, "another nested info")


def _judge_client(env: Env, request: Request | None, row: Row) -> str:
    """Decide for a client, which may leave by itself, and comes back in a new episode."""
    new, before = row.named[LIFE] != env.life, (env.episode, env.steps)
    if row.restarted:
        lie(request is None, "a loss that nobody asked for")
        lie(not row.info.get("client_lost"), "no cause")
        _check_marks(row)
        lie(not new and row.now < before, "not the last result", before)
        return "marked, of a client"
    lie("client_lost" in row.info, "a cause without a mark")
    lie(row.truncated or row.limit, "truncated, or a limit")
    env.note(row)
    if row.is_reset:
        lie(row.reward != 0 or row.named[TOKEN] != 0, "the answer to a step")
        lie(row.now[1] != 0 or (not new and row.now <= before), "not a new episode", before)
        return "reset or return, of a client"
    if request is None:
        raise Lie("nothing was asked")
    lie(request.kind != "step", "a step, and a reset was due")
    lie(new or row.now != (before[0], before[1] + 1), "not the next step", before)
    lie(request.fault in ENDLESS, "a result where there can be none")
    _judge_step(request, row)
    return "step"
