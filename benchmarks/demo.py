"""The program of `make run`: steps the envs of headline.py in turns, and shows both speeds live.

Ctrl-C ends it early, with the figures measured so far.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from contextlib import ExitStack

from harness import Stage, number_text
from headline import GYMNASIUM, OURS
from rich.console import Console
from rich.live import Live
from rich.table import Table

WIDTH = 32
NEXT_STEPS = """\
Next:
  examples/async_loop.py        first come, first served, in a few lines
  docs/start.md                 five minutes with your own script
  docs/tutorial.md              train on your own env
  docs/training.md              training loops
  rlightning-aio bench CONFIG   the best settings for your env on this machine (in .venv/bin)
  make docs                     all pages as a site
"""


def speeds(rates: dict[str, list[float]]) -> Table:
    """Return a row for each contender: a bar for its median rate, and the rate."""
    table = Table(title="32 HalfCheetah-v5, random actions", show_header=False, box=None)
    medians = {name: statistics.median(found) for name, found in rates.items() if found}
    fastest = max(medians.values(), default=1.0)
    for name in rates:
        median = medians.get(name, 0.0)
        rate = f"{number_text(median)} env steps/s" if median else "starts"
        table.add_row(name, f"{'█' * round(WIDTH * median / fastest):{WIDTH}}", rate)
    return table


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=10, help="turns of each (default: 10)")
    parser.add_argument("--seconds", type=float, default=0.4, help="of a turn (default: 0.4)")
    args = parser.parse_args()
    console = Console()
    rates: dict[str, list[float]] = {GYMNASIUM.name: [], OURS.name: []}
    interrupted = False
    try:
        with Live(speeds(rates), console=console) as live, ExitStack() as stack:
            stages = [stack.enter_context(Stage(c)) for c in (GYMNASIUM, OURS)]
            for _ in range(args.rounds):
                for stage in stages:
                    rate, _ = stage.round(args.seconds)
                    rates[stage.contender.name].append(rate)
                    live.update(speeds(rates))
    except KeyboardInterrupt:
        interrupted = True
    pairs = list(zip(rates[OURS.name], rates[GYMNASIUM.name], strict=False))
    if pairs:
        ratio = statistics.median(ours / theirs for ours, theirs in pairs)
        console.print(
            f"\nOn this machine make_vec is {ratio:.1f} times as fast as AsyncVectorEnv.\n"
        )
    console.print(NEXT_STEPS, highlight=False, soft_wrap=True)
    return 130 if interrupted else 0


if __name__ == "__main__":
    sys.exit(main())
