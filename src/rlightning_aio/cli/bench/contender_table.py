"""Shows the figures of `bench` and `tune`: a table on a terminal, CSV, Markdown."""

from __future__ import annotations

import csv
import io
from collections import Counter
from typing import TYPE_CHECKING, Final

from rlightning_aio.cli.terminal import count, counted, duration, named_columns, print_table
from rlightning_aio.sharing import num_cores

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from rlightning_aio.cli.bench.measuring import Contender

__all__ = ["as_csv", "as_markdown", "print_contenders"]

_NAMES: Final = (
    "envs in", "results", "steps/s", "±", "latency p50", "p99", "start", "reset", "cores", "memory",
)  # fmt: skip
_EXPENDABLE: Final = ("reset", "start", "memory", "p99", "cores", "±", "latency p50")
_FIGURES: Final = (
    "place", "results", "steps_per_second", "spread", "latency_us_p50", "latency_us_p99",
    "start_seconds", "reset_seconds", "cores", "memory_bytes",
)  # fmt: skip


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


def as_csv(contenders: Sequence[Contender]) -> str:
    """Return all figures in plain units: a line of names, then one for each contender."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(_FIGURES)
    for contender in contenders:
        names = [contender.setting.words, contender.rule.words]
        writer.writerow([*names, *_figures(contender)])
    return file.getvalue().rstrip()


def as_markdown(contenders: Sequence[Contender]) -> str:
    """Return the table in Markdown."""
    lines = [list(_NAMES), ["---", "---", *["---:"] * (len(_NAMES) - 2)]]
    lines += [_row(contender) for contender in contenders]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _figures(contender: Contender) -> list[float | None]:
    if not contender.rounds or contender.costs is None:
        return [None] * (len(_FIGURES) - 2)
    costs = contender.costs
    return [
        contender.steps_per_second,
        contender.spread,
        *contender.latency_us,
        costs.start_seconds,
        costs.reset_seconds,
        contender.cores,
        costs.memory_bytes,
    ]


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
