"""The program of `make run`: three kinds of envs, stepped by AsyncVectorEnv and by this library.

MuJoCo's envs in one batch, a plain Python env in workers, and an env that waits, 32 of each. The
two take turns, and the table is filled in live. Ctrl-C ends it early, with the figures so far.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from contenders import GymnasiumVector, OursVector, Work
from harness import Contender, Figures, Stage, number_text, throughput
from rich.console import Console
from rich.live import Live
from rich.table import Table
from waiting import BriefAwaiting

if TYPE_CHECKING:
    from collections.abc import Callable

NUM_ENVS = 32
NEXT_STEPS = """\
Next:
  examples/async_loop.py        first come, first served, in a few lines
  docs/start.md                 five minutes with your own script
  docs/tutorial.md              train on your own env
  docs/training.md              training loops
  rlightning-aio bench CONFIG   the best settings for your env on this machine (in .venv/bin)
  make docs                     all pages as a site
"""


@dataclass
class Awaited(Contender):
    """A group of awaitable envs on the event loop of one worker: first come, first served."""

    name: str = "build_env_group"

    def setup(self) -> None:
        from rlightning_aio import sync

        self._group = sync.build_env_group(BriefAwaiting, num_workers=NUM_ENVS, step_timeout=60)
        self._group.init()
        batch, _ = self._group.reset(seed=0)
        self._actions = np.zeros(NUM_ENVS, np.int64)
        self._group.step_async(batch.respond(action=self._actions))

    def round(self, seconds: float) -> float:
        return throughput(self._step, seconds)

    def _step(self) -> int:
        batch, _ = self._group.collect_async(min_results=1)
        self._group.step_async(batch.respond(action=self._actions[: len(batch)]))
        return len(batch)

    def teardown(self) -> None:
        self._group.close()


class Line(NamedTuple):
    """A line of the table: what is stepped, and who steps it."""

    title: str
    theirs: Contender
    ours: Contender


def theirs(task: str) -> Contender:
    """Return `AsyncVectorEnv`, which waits for the slowest env at each step."""
    return GymnasiumVector("AsyncVectorEnv", Work(task, NUM_ENVS), "async")


def ours(task: str, mode: str | None = None) -> Contender:
    """Return what `make_vec` makes."""
    return OursVector("make_vec", Work(task, NUM_ENVS), mode)


MUJOCO, PYTHON, SLEEPING = "HalfCheetah-v5", "CartPole-v1", "waiting:benchmarks/Sleeping-v0"
LINES = (
    Line("MuJoCo in one batch", theirs(MUJOCO), ours(MUJOCO)),
    Line("plain Python in workers", theirs(PYTHON), ours(PYTHON, "async")),
    Line("an env that waits", theirs(SLEEPING), Awaited()),
)


class Rates(NamedTuple):
    """Env steps per second of each round."""

    theirs: list[float]
    ours: list[float]

    def ratio(self) -> float:
        """Return how many times as fast ours is; both have played the same rounds."""
        return Figures(self.ours).over(Figures(self.theirs[: len(self.ours)])).median


def table_of(rates: list[Rates]) -> Table:
    """Return the table; a line that has not been measured says what happens."""
    title = f"Env steps per second of {NUM_ENVS} HalfCheetahs, CartPoles and awaitable envs"
    table = Table(title=title, box=None)
    table.add_column("")
    for title in ("AsyncVectorEnv", "rlightning_aio", "times as fast"):
        table.add_column(title, justify="right")
    for line, found in zip(LINES, rates, strict=False):
        if not found.ours:
            table.add_row(line.title, "starts")
            continue
        medians = [number_text(Figures(one).median) for one in found]
        table.add_row(line.title, *medians, f"{found.ratio():.1f}")
    return table


def measure(line: Line, found: Rates, rounds: int, seconds: float, show: Callable[[], Any]) -> None:
    """Have both take turns; add what they reach to `found`."""
    with ExitStack() as stack:
        stages = [stack.enter_context(Stage(one)) for one in (line.theirs, line.ours)]
        for _ in range(rounds):
            for stage, rates in zip(stages, found, strict=True):
                rate, _ = stage.round(seconds)
                rates.append(rate)
            show()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5, help="turns of each (default: 5)")
    parser.add_argument("--seconds", type=float, default=0.4, help="of a turn (default: 0.4)")
    args = parser.parse_args()
    console = Console()
    rates: list[Rates] = []
    interrupted = False
    try:
        with Live(table_of(rates), console=console) as live:
            for line in LINES:
                rates.append(Rates([], []))
                live.update(table_of(rates))
                show = lambda: live.update(table_of(rates))  # noqa: E731
                measure(line, rates[-1], args.rounds, args.seconds, show)
    except KeyboardInterrupt:
        interrupted = True
    console.print(f"\n{NEXT_STEPS}", highlight=False, soft_wrap=True)
    return 130 if interrupted else 0


if __name__ == "__main__":
    sys.exit(main())
