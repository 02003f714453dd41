"""Output of every command: the two streams, messages of errors, formats of figures.

Rule: stdout gets results and nothing else, even if other code prints. An error is one message on
stderr and an exit code, never a traceback; for the user's own code (a policy) it has the place.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import os
import re
import signal
import sys
from typing import TYPE_CHECKING, Any, TextIO

import typer
from rich.console import Console
from rich.measure import Measurement
from rich.table import Column, Table

import rlightning_aio
from rlightning_aio.errors import ConfigError, EnvFault, RemoteTraceback, RLightningError
from rlightning_aio.json_text import json_of
from rlightning_aio.protocol.net.limited_log import LOG

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Generator, Iterable, Sequence

__all__ = [
    "ResultStream",
    "connections_logged",
    "count",
    "counted",
    "duration",
    "err",
    "fitted",
    "guarded",
    "in_words",
    "interruptible",
    "named_columns",
    "notes_on_returns",
    "number",
    "out",
    "print_json",
    "print_result",
    "print_table",
    "run_interruptible",
]

_INTERRUPTED = 130
"""Exit code after Ctrl-C, as in shells."""


@contextlib.contextmanager
def connections_logged() -> Generator[None]:
    """Write one line on stderr for each change of a client's connection, on either side."""
    handler = logging.StreamHandler(err().file)
    level = LOG.level
    LOG.addHandler(handler)
    LOG.setLevel(logging.INFO)
    try:
        yield
    finally:
        LOG.removeHandler(handler)
        LOG.setLevel(level)


_NATURAL = 10_000
"""Width in which every table fits."""
_WIDE = 160
"""Width of a table in a file, whose readers wrap lines themselves."""


_NAMED = 8
"""Number of envs that a message names; further ones are counted."""
_LONG = 1e12
"""Smallest number that is written with a power of ten."""


_results: list[TextIO] = []
"""The stream for results while a command runs; stdout itself leads to stderr then."""


def out() -> Console:
    """Return the console for results."""
    return _console(_results[-1] if _results else sys.stdout)


def err() -> Console:
    """Return the console for all other messages."""
    return _console(sys.stderr)


def _console(file: TextIO) -> Console:
    return Console(file=file, highlight=False, width=None if file.isatty() else _WIDE)


def print_result(text: str) -> None:
    """Print `text` on stdout, unchanged."""
    typer.echo(text, file=_results[-1] if _results else None)


def print_json(value: Any) -> None:
    """Print `value` as the one JSON document on stdout."""
    print_result(json_of(value, indent=2))


def notes_on_returns(env_ids: Iterable[str]) -> list[str]:
    """Return a note on envs whose returns are not finite, or an empty list."""
    named = sorted(set(env_ids))
    if not named:
        return []
    more = f" and {count(len(named) - _NAMED)} more" if len(named) > _NAMED else ""
    note = f"returns of {', '.join(named[:_NAMED])}{more} are NaN, infinite or too large to add up"
    return [f"{note}; figures with them are left out"]


class ResultStream:
    """Stdout that turns a full disk into one `ConfigError`. Click handles a closed pipe."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._is_lost = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        return self._try(self._stream.write, text) or 0

    def flush(self) -> None:
        self._try(self._stream.flush)

    def _try(self, method: Callable[..., Any], *args: Any) -> Any:
        if self._is_lost:
            return None
        try:
            return method(*args)
        except OSError as error:
            self._discard_rest()
            if isinstance(error, BrokenPipeError):
                raise
            self._is_lost = True
            raise ConfigError(f"stdout: results can't be written: {error.strerror}") from error

    def _discard_rest(self) -> None:
        """Let the stream's end, which writes what it still holds, succeed."""
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, self._stream.fileno())
        os.close(null)


@contextlib.contextmanager
def _prints_on_stderr() -> Generator[None]:
    """Redirect all printing inside this context to stderr."""
    _results.append(sys.stdout)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        _results.pop().flush()


def guarded(command: Callable[..., None]) -> Callable[..., None]:
    """Return `command` with the library's errors and Ctrl-C turned into messages and exit codes."""

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            with _prints_on_stderr():
                command(*args, **kwargs)
        except RLightningError as error:
            typer.echo(f"error: {in_words(error)}", err=True)
            raise typer.Exit(2 if isinstance(error, ConfigError) else 1) from None
        except TimeoutError as error:  # A group's clients have not connected in time.
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(1) from None
        except KeyboardInterrupt:
            raise typer.Exit(_INTERRUPTED) from None

    return run


@contextlib.contextmanager
def interruptible() -> Generator[None]:
    """Make Ctrl-C raise KeyboardInterrupt inside this context, so that envs are closed.

    The other signals that end a command do the same: SIGTERM, with which a service manager stops
    a robot's client; SIGHUP, sent when a terminal or SSH session closes (unless it is ignored, as
    under nohup); and SIGQUIT. Outside this context they end the command at once (see `cli.main`).
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


def run_interruptible(command: Coroutine[Any, Any, None]) -> None:
    """Run `command` on an event loop inside `interruptible`; its envs are closed at the end."""
    with interruptible(), contextlib.closing(command):
        rlightning_aio.run(command)


def in_words(error: RLightningError) -> str:
    """Return the message, with the place in the env's code instead of a traceback."""
    text = str(error)
    if isinstance(error.__cause__, RemoteTraceback):
        places = re.findall(r'^  File (".*", line \d+, in .*)$', error.__cause__.text, re.MULTILINE)
        where = f"it happened in {places[-1]}" if places else "its traceback was lost"
        text = text.replace("its __cause__ is the remote traceback", where)
    if isinstance(error, EnvFault) and error.others:
        text += f"\n(and {len(error.others)} more envs of the same call)"
    return text


def named_columns(title: str, *names: str, texts: Sequence[str] = ()) -> Table:
    """Return an empty table: the first column and `texts` are text, all others are figures."""
    table = _empty(title)
    for position, name in enumerate(names):
        is_text = position == 0 or name in texts
        table.add_column(
            name, justify="left" if is_text else "right", overflow="fold", vertical="bottom"
        )
    return table


def _empty(title: Any, *columns: Column) -> Table:
    return Table(
        *columns, title=title, title_justify="left", title_style="bold", box=None, pad_edge=False
    )


def fitted(console: Console, table: Table, expendable: Sequence[str]) -> tuple[Table, list[str]]:
    """Return `table` without the columns that don't fit the console, and their names.

    Args:
        console: the console to print on.
        table: a table of `named_columns`.
        expendable: names of columns that may be left out, the least important first.
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
    """Print `table`, without some of its `expendable` columns if it is too wide."""
    table, left_out = fitted(console, table, expendable)
    console.print(table)
    if left_out:
        words = f"(too narrow for {', '.join(left_out)}; --json has all)"
        console.print(words, style="dim", markup=False)


def count(value: float) -> str:
    """Return the text of a count, or of a rate of counts."""
    return f"{value:,.0f}"


def counted(how_many: int, what: str) -> str:
    """Return a text such as "1 env", "16 envs" or "0 worker processes"."""
    plural = "es" if what.endswith("s") else "s"
    return f"{count(how_many)} {what}{'' if how_many == 1 else plural}"


def number(value: float | None) -> str:
    """Return the text of any other figure, or a dash if it is missing or not finite."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:,.2f}" if abs(value) < _LONG else f"{value:.4g}"


def duration(microseconds: float | None) -> str:
    """Return the text of a time, in a unit that suits its size."""
    if microseconds is None:
        return "-"
    if microseconds < 1e3:
        return f"{microseconds:.0f} µs"
    if microseconds < 1e6:
        return f"{microseconds / 1e3:.1f} ms"
    return f"{microseconds / 1e6:.1f} s"
