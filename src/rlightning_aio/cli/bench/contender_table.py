"""Shows the figures of `bench` in a table."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

from rlightning_aio.cli.terminal import count, counted, duration, named_columns, print_table
from rlightning_aio.sharing import num_cores

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from rlightning_aio.cli.bench.measuring import Contender

__all__ = ["print_contenders"]

_NAMES: Final = (
    "envs in", "results", "steps/s", "±", "latency p50", "p99", "start", "reset", "cores", "memory",
)  # fmt: skip
_EXPENDABLE: Final = ("reset", "start", "memory", "p99", "cores", "±", "latency p50")


def print_contenders(console: Console, title: str, contenders: Sequence[Contender]) -> None:
    """Print a table of the figures, with the fastest in bold."""
    fastest = max(contenders, key=lambda contender: contender.steps_per_second)
    table = named_columns(
        f"{title}: {counted(num_cores(), 'core')}, "
        f"medians of {counted(len(fastest.rounds), 'round')}",
        *_NAMES,
    )
    table.columns[1].justify = "left"
    for contender in contenders:
        table.add_row(*_row(contender), style="bold" if contender is fastest else None)
    print_table(console, table, _EXPENDABLE)
    failures = {c.setting.words: c.failure for c in contenders if c.failure}
    for words, failure in failures.items():
        console.print(f"{words}: {failure}", markup=False)
    restarts = Counter[str]()
    for contender in contenders:
        restarts[contender.setting.words] += contender.restarts
    for words, times in (+restarts).items():
        console.print(f"{words}: {counted(times, 'restart')} of a worker that died", markup=False)


def _row(contender: Contender) -> list[str]:
    names = [contender.setting.words, contender.rule.words]
    if not contender.rounds or contender.costs is None:
        return [*names, *["-"] * (len(_NAMES) - 2)]
    costs = contender.costs
    return [
        *names,
        count(contender.steps_per_second),
        f"{contender.spread:.0%}" if len(contender.rounds) > 1 else "-",
        *map(duration, contender.latency_us),
        duration(costs.start_seconds * 1e6),
        duration(costs.reset_seconds * 1e6),
        f"{contender.cores:.1f}",
        f"{costs.memory_bytes / 2**20:,.0f} MiB",
    ]
