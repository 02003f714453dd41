"""What every command shares: the two output streams, how errors end it, how figures look.

Rule: stdout has results and nothing else, whoever prints. An error is one message on stderr and
an exit code, never a traceback; one in the user's own code (a policy) says where it happened there.
"""

from __future__ import annotations

import contextlib
import functools
import json
import re
import signal
import sys
from typing import TYPE_CHECKING, Any, TextIO

import typer
from rich.console import Console
from rich.measure import Measurement
from rich.table import Column, Table

from rlightning_aio.errors import ConfigError, EnvFault, RemoteTraceback, RLightningError

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence

__all__ = [
    "INTERRUPTED",
    "count",
    "counted",
    "duration",
    "err",
    "fitted",
    "guarded",
    "interruptible",
    "named_columns",
    "number",
    "out",
    "print_json",
    "print_result",
    "print_table",
]

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""

_NATURAL = 10_000
"""Columns in which any table has room."""
_WIDE = 160
"""Columns of a table that goes to a file: what reads it wraps lines itself."""


_results: list[TextIO] = []
"""Where results go while a command runs; stdout itself leads to stderr then."""


def out() -> Console:
    """The console for results."""
    return _console(_results[-1] if _results else sys.stdout)


def err() -> Console:
    """The console for what is said on the way."""
    return _console(sys.stderr)


def _console(file: TextIO) -> Console:
    return Console(file=file, highlight=False, width=None if file.isatty() else _WIDE)


def print_result(text: str) -> None:
    """Print `text` on stdout as it is."""
    typer.echo(text, file=_results[-1] if _results else None)


def print_json(value: Any) -> None:
    """Print `value` as the one JSON document on stdout."""
    print_result(json.dumps(value, indent=2, allow_nan=False))


@contextlib.contextmanager
def _prints_on_stderr() -> Generator[None]:
    """What anybody prints in here goes to stderr; stdout has results and nothing else."""
    _results.append(sys.stdout)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        _results.pop().flush()


def guarded(command: Callable[..., None]) -> Callable[..., None]:
    """`command`, with errors of the library turned into messages and exit codes."""

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            with _prints_on_stderr():
                command(*args, **kwargs)
        except RLightningError as error:
            typer.echo(f"error: {_in_words(error)}", err=True)
            raise typer.Exit(2 if isinstance(error, ConfigError) else 1) from None
        except TimeoutError as error:  # Of a group: clients that didn't come.
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(1) from None
        except KeyboardInterrupt:
            raise typer.Exit(INTERRUPTED) from None

    return run


@contextlib.contextmanager
def interruptible() -> Generator[None]:
    """Ctrl-C raises KeyboardInterrupt in here, where there is something to clean up.

    So does every other signal that ends a command: SIGTERM, with which a service manager stops
    a robot's client, SIGHUP, which comes when a terminal or an SSH session closes (unless it is
    ignored, as under nohup), and SIGQUIT. Anywhere else they end the command on the spot (see
    `cli.main`).
    """
    numbers = [signal.SIGINT, signal.SIGTERM, signal.SIGQUIT]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = [signal.signal(number, signal.default_int_handler) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def _in_words(error: RLightningError) -> str:
    """The message, with the place in the env's code in place of a traceback."""
    text = str(error)
    if isinstance(error.__cause__, RemoteTraceback):
        places = re.findall(r'^  File (".*", line \d+, in .*)$', error.__cause__.text, re.MULTILINE)
        where = f"it happened in {places[-1]}" if places else "its traceback is lost"
        text = text.replace("the remote traceback is above", where)
    if isinstance(error, EnvFault) and error.others:
        text += f"\n(and {len(error.others)} more envs of the same call)"
    return text


def named_columns(title: str, *names: str) -> Table:
    """An empty table: the first column is text, all others are figures."""
    table = _empty(title)
    for position, name in enumerate(names):
        table.add_column(
            name, justify="right" if position else "left", overflow="fold", vertical="bottom"
        )
    return table


def _empty(title: Any, *columns: Column) -> Table:
    return Table(
        *columns, title=title, title_justify="left", title_style="bold", box=None, pad_edge=False
    )


def fitted(console: Console, table: Table, expendable: Sequence[str]) -> tuple[Table, list[str]]:
    """`table` without as many columns as it takes to fit the console, and what they are called.

    Args:
        console: where it goes.
        table: of `named_columns`.
        expendable: names of columns, those first that are missed least.
    """
    wide = console.options.update(max_width=_NATURAL, width=_NATURAL)
    left_out: list[str] = []
    for name in expendable:
        if Measurement.get(console, wide, table).maximum <= console.width:
            break
        rows = table.rows
        table = _empty(table.title, *(c for c in table.columns if c.header != name))
        table.rows = rows
        left_out.append(name.replace("\n", " ").strip())
    return table, left_out


def print_table(console: Console, table: Table, expendable: Sequence[str] = ()) -> None:
    """Print `table`, without some of its `expendable` columns where it is too wide."""
    table, left_out = fitted(console, table, expendable)
    console.print(table)
    if left_out:
        words = f"(too narrow for {', '.join(left_out)}; --json has all)"
        console.print(words, style="dim", markup=False)


def count(value: float) -> str:
    """A count, or a rate of counts."""
    return f"{value:,.0f}"


def counted(how_many: int, what: str) -> str:
    """Such as "1 env", "16 envs" and "0 envs"."""
    return f"{count(how_many)} {what}{'' if how_many == 1 else 's'}"


def number(value: float | None) -> str:
    """Any other figure; a dash where there is none."""
    return "-" if value is None else f"{value:,.2f}"


def duration(microseconds: float | None) -> str:
    """A time in the unit that suits its size."""
    if microseconds is None:
        return "-"
    if microseconds < 1e3:
        return f"{microseconds:.0f} µs"
    if microseconds < 1e6:
        return f"{microseconds / 1e3:.1f} ms"
    return f"{microseconds / 1e6:.1f} s"
