"""Own envs of several step costs: when is `VectorEnv` worth it, and is its hint right?

    python benchmarks/own_envs.py                       # all cells, ten minutes
    python benchmarks/own_envs.py --only "20 µs" --only "5 ms"

A cell is what a step costs times the number of envs. In each, `SyncVectorEnv`, `AsyncVectorEnv`,
`VectorEnv` as it comes and with each other setting take turns in one process. The group's hint is
to name the best setting, and what it brings, wherever that is 1.5 times as fast, and nowhere else;
between 1.3 and 1.7 either is right.
"""

from __future__ import annotations

import logging
import re
import time
import timeit
from contextlib import ExitStack, closing
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from contenders import CORES
from harness import Figures, number_text, parser_of, say, tell, throughput

from rlightning_aio._core.group.supervision.hint import LAST_LOOK
from rlightning_aio.cli.measurement import machine_facts
from rlightning_aio.vector import VectorEnv

COSTS = {f"{micros:,} µs": micros for micros in (2, 20, 100, 500, 2000)} | {"waits 5 ms": 0}
NUMBERS = (1, 4, 16, 32)
SYNC, ASYNC, OURS = "SyncVectorEnv", "AsyncVectorEnv", "VectorEnv"
BORDER = (1.3, 1.7)
HINT = re.compile(r"about ([\d.]+) times as fast, set (placement: inline|envs_per_process: \d+)")


class Own(gym.Env[Any, Any]):
    """Computes for so many turns of a loop, or waits; three numbers are its observation."""

    observation_space = action_space = gym.spaces.Box(-1, 1, (3,))

    def __init__(self, turns: int) -> None:
        self._turns, self._observation = range(turns), np.zeros(3, np.float32)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        del seed, options
        return self._observation, {}

    def step(self, action: Any) -> Any:
        del action
        for _ in self._turns:
            pass
        if not self._turns:
            time.sleep(0.005)
        return self._observation, 0.0, False, False, {}


def turns_of(micros: float) -> int:
    """Return how many turns take that long where nothing disturbs them."""
    seconds = timeit.repeat(partial(Own(20_000).step, None), number=1, repeat=50)
    return round(micros * 20_000 / (1e6 * min(seconds))) if micros else 0


for _micros in (20, 200):
    gym.register(f"benchmarks/Own{_micros}-v0", Own, kwargs={"turns": turns_of(_micros)})


def cell(micros: float, count: int, rounds: int, seconds: float) -> dict[str, Any]:
    """Measure one cell; return the medians of all contenders and what the hint said."""
    heard: list[str] = []
    handler, log = logging.Handler(), logging.getLogger("rlightning_aio")
    handler.emit = lambda record: heard.append(record.getMessage())
    makers, actions = [partial(Own, turns_of(micros))] * count, np.zeros((count, 3), np.float32)
    settings: dict[str, Any] = {OURS: {}, "placement: inline": {"placement": "inline"}}
    for each in (1, -(-count // CORES)):
        settings[f"envs_per_process: {each}"] = {"envs_per_process": each}
    with ExitStack() as stack:
        theirs: dict[str, Any] = {SYNC: gym.vector.SyncVectorEnv, ASYNC: gym.vector.AsyncVectorEnv}
        envs = {name: kind(makers) for name, kind in theirs.items()}
        envs |= {name: VectorEnv(makers, **given) for name, given in settings.items()}
        rates: dict[str, list[float]] = {name: [] for name in envs}
        for env in envs.values():
            stack.enter_context(closing(env)).reset()

        def step(env: Any) -> int:
            env.step(actions)
            return count

        # As a pause is part of a turn, the group that looks for a hint is stepped without any.
        log.addHandler(handler)
        until, turns = time.perf_counter() + 3, 0
        while not heard and turns < LAST_LOOK and time.perf_counter() < until:
            turns += step(envs[OURS]) // count
        log.removeHandler(handler)
        for _ in range(rounds):
            for name, env in envs.items():
                rates[name].append(throughput(partial(step, env), seconds))
    ours = Figures(rates[OURS])
    gains = {name: Figures(rates[name]).over(ours).median for name in envs}
    others = {name: gain for name, gain in gains.items() if ":" in name}
    best = max(others, key=lambda name: others[name])
    said = HINT.search("".join(heard))
    named, promised = (said[2], float(said[1])) if said else ("", 0.0)
    hint_is_right = BORDER[0] <= others[best] <= BORDER[1] or (
        others.get(named, 0.0) > max(BORDER[0], 0.75 * others[best]) if named
        else others[best] < BORDER[0]
    )  # fmt: skip
    medians = {name: Figures(found).median for name, found in rates.items()}
    return {
        "medians": medians, "gains": gains, "best": best, "named": named, "promised": promised,
        "hint_is_right": hint_is_right,
    }  # fmt: skip


def row(title: str, found: dict[str, Any]) -> str:
    """Return a cell as a row of the table: rates, ours as a multiple, the hint."""
    gains, named = found["gains"], found["named"]
    rates = [number_text(found["medians"][name]) for name in (SYNC, ASYNC, OURS)]
    times = f"{1 / gains[SYNC]:.2f} | {1 / gains[ASYNC]:.2f}"
    hint = f"{named}, {found['promised']:.1f}" if named else "-"
    measured = (
        f"{gains[named]:.1f} | {gains[named] / gains[SYNC]:.2f}" if named in gains else "- | -"
    )
    best = f"{found['best']}, {gains[found['best']]:.1f}"
    right = "" if found["hint_is_right"] else " (wrong)"
    return f"| {title} | {' | '.join(rates)} | {times} | {hint}{right} | {measured} | {best} |"


def main() -> None:
    given = parser_of(__doc__, rounds=5, seconds=0.4).parse_args()
    found: dict[str, Any] = {}
    for name, micros in COSTS.items():
        for count in NUMBERS:
            title = f"{name}, {count} envs"
            if not given.only or any(part in title for part in given.only):
                found[title] = cell(micros, count, given.rounds, given.seconds)
                say(row(title, found[title]))
    head = f"| a step | {SYNC} | {ASYNC} | {OURS} | times {SYNC} | times {ASYNC} "
    head += f"| the hint | brings | then times {SYNC} | best setting |"
    lines = [head, "|---" + "|---:" * 5 + "|---|---:|---:|---|"]
    report = {
        "name": "own_envs", "title": "Own envs", "rounds": given.rounds, "targets": [],
        "machine": machine_facts({"gymnasium"}), "results": found,
        "tables": "\n".join([*lines, *(row(title, one) for title, one in found.items())]),
    }  # fmt: skip
    tell(report, given)


if __name__ == "__main__":
    main()
