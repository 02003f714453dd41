"""The program of `make run`: four kinds of envs, stepped by Gymnasium and by this library.

CartPole, MuJoCo's envs in one batch, an own env in workers, and one that waits, 32 of each. What
`gymnasium.make_vec` makes by default, AsyncVectorEnv and this library take turns, and the table is
filled in live. Ctrl-C ends it early, with the figures so far.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, NamedTuple

from contenders import GymnasiumVector, OursAsync, OursVector, Work
from harness import Contender, Figures, Stage, number_text
from rich.console import Console
from rich.live import Live
from rich.table import Table

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


class Line(NamedTuple):
    """A line of the table: what is stepped, and what steps it here."""

    title: str
    task: str
    ours: Contender | None = None

    def contenders(self) -> list[Contender]:
        """Return Gymnasium's default, its `AsyncVectorEnv`, and this library."""
        work = Work(self.task, NUM_ENVS, None)
        theirs = [GymnasiumVector("", work), GymnasiumVector("", work, "async")]
        return [*theirs, self.ours or OursVector("", work)]


WAITING = "waiting:benchmarks/Sleeping-v0"
LINES = (
    Line("CartPole", "CartPole-v1"),
    Line("HalfCheetah, batched", "HalfCheetah-v5"),
    Line("own env of 200 µs", "own_envs:benchmarks/Own200-v0"),
    Line("own env that waits", WAITING, OursAsync("", Work(WAITING, NUM_ENVS, None))),
)
WHY = "CartPole is no faster: a step costs less than the way to a worker, so it is Gymnasium's."


def table_of(rates: list[list[list[float]]]) -> Table:
    """Return the table of the rates of each line; one that was not measured says what happens."""
    table = Table(title=f"Env steps per second of {NUM_ENVS} envs", box=None)
    for title in ("", "make_vec", "AsyncVectorEnv", "rlightning_aio", "times as fast"):
        table.add_column(title, justify="right" if title else "left", no_wrap=True)
    for line, found in zip(LINES, rates, strict=False):
        if not found[-1]:
            table.add_row(line.title, "starts")
            continue
        *theirs, ours = [Figures(one) for one in found]
        # All have played the rounds of ours.
        ratios = [ours.over(Figures(one.values[: len(ours.values)])).median for one in theirs]
        medians = [number_text(one.median) for one in (*theirs, ours)]
        digits = [0 if ratio >= 10 else 1 for ratio in ratios]  # A terminal has 80 columns.
        times = [f"{ratio:.{n}f}" for ratio, n in zip(ratios, digits, strict=True)]
        table.add_row(line.title, *medians, " and ".join(times))
    return table


def measure(
    line: Line, found: list[list[float]], rounds: int, seconds: float, show: Callable[[], Any]
) -> None:
    """Have all take turns; add what they reach to `found`."""
    with ExitStack() as stack:
        stages = [stack.enter_context(Stage(one)) for one in line.contenders()]
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
    rates: list[list[list[float]]] = []
    interrupted = False
    try:
        with Live(table_of(rates), console=console) as live:
            for line in LINES:
                rates.append([[], [], []])
                live.update(table_of(rates))
                show = lambda: live.update(table_of(rates))  # noqa: E731
                measure(line, rates[-1], args.rounds, args.seconds, show)
    except KeyboardInterrupt:
        interrupted = True
    console.print(f"\n{WHY}\n\n{NEXT_STEPS}", highlight=False, soft_wrap=True)
    return 130 if interrupted else 0


if __name__ == "__main__":
    sys.exit(main())
