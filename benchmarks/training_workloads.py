"""The workloads, contenders and targets of `training.py`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from uneven_pole import UNEVEN

if TYPE_CHECKING:
    from collections.abc import Sequence

ASYNC = "AsyncVectorEnv"
SYNC = "SyncVectorEnv"
BASELINES = (ASYNC, SYNC)
TOGETHER_WITH = ("make_vec", "EnvPool")
"""Vector environments that step all together, in the baselines' loop."""
# References of a target other than contenders.
BETTER = "the better baseline"
SPREAD = "the baselines' spread"


@dataclass(frozen=True)
class Contender:
    """One of `BASELINES` or `TOGETHER_WITH`, or an example, with its changes to the preset."""

    name: str
    example: str = ""
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Target:
    """A bound for a contender's figure.

    Attributes:
        what: ``wall`` or ``outside`` (seconds), ``rate`` (transitions a second), ``busy`` (share
            of the time in which an env steps) or ``return`` (of the last episodes).
        reference: whose figure of the same seed it is divided by; `SPREAD`: the mean is held
            against the baselines' lowest; empty: the figure itself is bounded.
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
    """A task to learn, with its settings and contenders.

    Attributes:
        preset: the examples' class of arguments.
        settings: changes to the preset for all contenders.
        num_envs: sub-environments counted.
    """

    name: str
    title: str
    preset: str
    num_envs: int
    settings: dict[str, Any]
    contenders: Sequence[Contender]
    targets: Sequence[Target]


TOGETHER = {"placement": "inline", "num_envs": 2, "envs_each": 8, "min_results": 1}
PLAIN = ("ppo", "ppo_async")
BATCHED = "ppo_async, 2 x 8"
OVERLAP = ("ppo_overlap", "ppo_overlap, 2 x 8")
IN_ONE_PROCESS = ("ppo", BATCHED, OVERLAP[1])
"""MuJoCo's threads step their simulations in the trainer's process."""

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
        Target("ppo_async", "outside", ASYNC, 0.35),
        *(Target(who, "outside", BETTER, 0.75) for who in PLAIN),
        *(Target(who, "outside", ASYNC, 0.25) for who in IN_ONE_PROCESS),
        Target(BATCHED, "outside", BETTER, 0.5),
        *(Target(who, "wall", ASYNC, 0.65) for who in ("ppo_async", BATCHED)),
        Target("ppo", "wall", ASYNC, 0.6),
        Target(OVERLAP[0], "wall", ASYNC, 0.55),
        Target(OVERLAP[1], "wall", ASYNC, 0.5),
        *(Target(who, "wall", SYNC, 1.0, every=True) for who in (*PLAIN, BATCHED, *OVERLAP)),
    ],
)

POOL = Workload(
    "pool",
    "HalfCheetah-v5, 16 envs, 100 k transitions, one loop",
    "Args",
    16,
    {"total_steps": 100_000},
    [Contender(ASYNC), *map(Contender, TOGETHER_WITH)],
    [
        Target("make_vec", "wall", "EnvPool", 1.0),
        Target("make_vec", "outside", "EnvPool", 0.8),
        Target("make_vec", "return", SPREAD, 0, at_most=False),
        Target("make_vec", "wall", ASYNC, 0.6),
        Target("make_vec", "outside", ASYNC, 0.35),
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

# Each env in its own worker, stepped again as soon as it is ready.
APART = {"placement": "process", "envs_per_process": 1, "envs_each": 1, "min_results": 1}
# SyncVectorEnv, where envs sleep one after the other, would take 32 times as long.
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

WORKLOADS = (CHEETAH, POOL, CARTPOLE, UNEVEN_POLE)
