"""What `training.py` has learned, by whom, and what is asked of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from uneven_pole import UNEVEN

if TYPE_CHECKING:
    from collections.abc import Sequence

ASYNC = "AsyncVectorEnv"
SYNC = "SyncVectorEnv"
BASELINES = (ASYNC, SYNC)
# References of a target that are no contender.
BETTER = "the better baseline"
SPREAD = "the baselines' spread"


@dataclass(frozen=True)
class Contender:
    """Who trains: one of `BASELINES`, or an example, and what it has otherwise than its preset."""

    name: str
    example: str = ""
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Target:
    """What is asked of a contender.

    Attributes:
        what: ``wall`` or ``outside`` (seconds), ``rate`` (transitions a second), ``busy`` (share
            of the time in which an env steps) or ``return`` (of the last episodes).
        reference: whose figure of the same seed it is divided by; `SPREAD`: the mean is held
            against the baselines' lowest; empty: it is bounded as it is.
        every: the bound holds for every seed, not for the median.
    """

    subject: str
    what: str
    reference: str
    bound: float
    at_most: bool = True
    every: bool = False


@dataclass(frozen=True)
class Workload:
    """What is learned.

    Attributes:
        preset: the examples' class of arguments.
        settings: what all contenders have otherwise than the preset.
        num_envs: sub-environments counted.
    """

    name: str
    title: str
    preset: str
    num_envs: int
    settings: dict[str, Any]
    contenders: Sequence[Contender]
    targets: Sequence[Target]


TOGETHER = {"num_envs": 2, "envs_each": 8, "min_batch": 1}
PLAIN = ("ppo", "ppo_async")
BATCHED = "ppo_async, 2 x 8"
OVERLAP = ("ppo_overlap", "ppo_overlap, 2 x 8")

CHEETAH = Workload(
    "cheetah",
    "HalfCheetah-v5, 16 envs, 1 M transitions",
    "Args",
    16,
    {},
    [
        Contender(ASYNC),
        Contender(SYNC),
        Contender("ppo", "ppo"),
        Contender("ppo_async", "ppo_async"),
        Contender(BATCHED, "ppo_async", TOGETHER),
        Contender(OVERLAP[0], "ppo_overlap"),
        Contender(OVERLAP[1], "ppo_overlap", TOGETHER),
    ],
    [
        *(Target(who, "return", SPREAD, 0, at_most=False) for who in (*PLAIN, BATCHED, *OVERLAP)),
        *(Target(who, "outside", ASYNC, 0.35) for who in PLAIN),
        *(Target(who, "outside", BETTER, 0.75) for who in PLAIN),
        Target(BATCHED, "outside", ASYNC, 0.25),
        Target(BATCHED, "outside", BETTER, 0.5),
        *(Target(who, "wall", ASYNC, 0.65) for who in (*PLAIN, BATCHED)),
        *(Target(who, "wall", ASYNC, 0.55) for who in OVERLAP),
        *(Target(who, "wall", SYNC, 1.0, every=True) for who in (*PLAIN, BATCHED, *OVERLAP)),
    ],
)

CARTPOLE = Workload(
    "cartpole",
    "CartPole-v1, 4 envs, 500 k transitions",
    "CartPole",
    4,
    {},
    [
        Contender(ASYNC),
        Contender(SYNC),
        Contender("ppo_async, inline", "ppo_async"),
        Contender("ppo_overlap, inline", "ppo_overlap"),
    ],
    [
        Target("ppo_async, inline", "return", SPREAD, 0, at_most=False),
        Target("ppo_async, inline", "wall", BETTER, 0.7),
        Target("ppo_overlap, inline", "wall", BETTER, 0.7),
    ],
)

# Each env in a worker of its own, answered as soon as it is ready.
APART = {"placement": "process", "envs_per_process": 1, "envs_each": 1, "min_batch": 1}
# SyncVectorEnv, which sleeps for one env after the other, would take 32 times as long.
UNEVEN_POLE = Workload(
    "uneven",
    "CartPole-v1, 32 envs of 2 to 30 ms a step, 100 k transitions",
    "CartPole",
    32,
    {"task": UNEVEN, "total_steps": 100_000, "num_envs": 32, "num_steps": 64},
    [
        Contender(ASYNC),
        *(Contender(name, name, APART) for name in ("ppo_async", "ppo_overlap")),
    ],
    [
        *(Target(who, "rate", BETTER, 2.5, at_most=False) for who in ("ppo_async", "ppo_overlap")),
        Target("ppo_overlap", "busy", "", 0.9, at_most=False),
    ],
)

WORKLOADS = (CHEETAH, CARTPOLE, UNEVEN_POLE)
