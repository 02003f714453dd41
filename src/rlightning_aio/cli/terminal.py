"""Output of every command: the two streams, messages of errors, progress, formats of figures.

Rule: stdout gets results and nothing else, even if other code prints. An error is one message on
stderr and an exit code, never a traceback; for the user's own code (a policy) it has the place.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import re
import signal
import sys
import time
from typing import TYPE_CHECKING, Any, Final, Self, TextIO

import typer
from rich import progress
from rich.console import Console
from rich.table import Table

import rlightning_aio
from rlightning_aio.errors import ConfigError, EnvFault, RemoteTraceback, RLightningError
from rlightning_aio.json_text import json_of
from rlightning_aio.protocol.error_text import LOG

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Generator, Iterable, Sequence

INTERRUPTED: Final = 130
"""Exit code after Ctrl-C, as in shells."""
_WIDE: Final = 160
"""Width of a table in a file, whose readers wrap lines themselves."""
_REFRESH_SECONDS: Final = 0.25

_results: list[TextIO] = []
"""The stream for results while a command runs; stdout itself leads to stderr then."""


# -- results --------------------------------------------------------------------------


def _console(file: TextIO) -> Console:
    return Console(file=file, highlight=False, width=None if file.isatty() else _WIDE)


def print_table(table: Table) -> None:
    """Print `table` on stdout."""
    _console(_results[-1]).print(table)


def print_lines(lines: Iterable[str]) -> None:
    """Print lines on stdout, unchanged."""
    for line in lines:
        typer.echo(line, file=_results[-1])


def print_json(value: Any) -> None:
    """Print `value` as the one JSON document on stdout."""
    print_lines([json_of(value, indent=2)])


@contextlib.contextmanager
def _prints_on_stderr() -> Generator[None]:
    """Redirect all printing inside this context to stderr."""
    _results.append(sys.stdout)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        _results.pop()


def named_columns(title: str, *names: str, texts: Sequence[str] = ()) -> Table:
    """Return an empty table: the first column and `texts` are text, all others are figures."""
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False)
    for position, name in enumerate(names):
        is_text = position == 0 or name in texts
        table.add_column(
            name, justify="left" if is_text else "right", overflow="fold", vertical="bottom"
        )
    return table


# -- errors and signals ---------------------------------------------------------------


def exit_code_of(command: Callable[[], None]) -> int:
    """Run a command. Return its exit code, after a message on stderr if it has failed."""
    try:
        command()
    except RLightningError as error:
        typer.echo(f"error: {in_words(error)}", err=True)
        return 2 if isinstance(error, ConfigError) else 1
    except TimeoutError as error:  # Such as of an arm.
        typer.echo(f"error: {error}", err=True)
        return 1
    except BrokenPipeError:
        raise  # Click ends the command: who reads its results has gone.
    except OSError as error:  # Of a file that an option names.
        typer.echo(f"error: {error}", err=True)
        return 2
    except KeyboardInterrupt:
        return INTERRUPTED
    except typer.Exit as end:
        return end.exit_code
    return 0


def guarded(command: Callable[..., None]) -> Callable[..., None]:
    """Return `command` with the library's errors and Ctrl-C turned into messages and exit codes."""

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        with _prints_on_stderr():
            code = exit_code_of(functools.partial(command, *args, **kwargs))
        if code:
            raise typer.Exit(code)

    return run


@contextlib.contextmanager
def interruptible() -> Generator[None]:
    """Make Ctrl-C raise KeyboardInterrupt inside this context, so that envs are closed.

    The other signals that end a command do the same: SIGTERM, with which a service manager stops
    a robot's client; SIGHUP, sent when a terminal or SSH session closes (unless it is ignored, as
    under nohup); and SIGQUIT. Outside this context they end the command at once (see `cli.main`).
    """
    with handling(signal.default_int_handler):
        yield


@contextlib.contextmanager
def handling(handler: Callable[[int, Any], Any]) -> Generator[None]:
    """Call `handler` for the signals that end a command, inside this context."""
    numbers = [signal.SIGINT, signal.SIGTERM, signal.SIGQUIT]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = [signal.signal(number, handler) for number in numbers]
    try:
        yield
    finally:
        for number, handler_before in zip(numbers, before, strict=True):
            signal.signal(number, handler_before)


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


# -- progress -------------------------------------------------------------------------


class Progress:
    """How far a command is, on stderr: a bar if that is a terminal, else a line for each stage."""

    def __init__(self) -> None:
        self._console = _console(sys.stderr)
        self._bar = progress.Progress(
            progress.SpinnerColumn(),
            progress.BarColumn(20),
            progress.TextColumn("{task.description}", markup=False),
            progress.TimeRemainingColumn(compact=True),
            console=self._console,
            transient=True,
            refresh_per_second=1 / _REFRESH_SECONDS,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task("", total=None)
        self._next_at = 0.0

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def begin(self, words: str, total: float | None = None) -> None:
        """Say what begins, and how much there is to do."""
        if self._bar.disable:
            self.say(words)
        self._bar.reset(self._task, description=words, total=total)

    def say(self, words: str) -> None:
        """Print a line that stays."""
        self._console.print(words, soft_wrap=True, markup=False)

    async def show(self, done: float, words: Callable[[], str]) -> None:
        """Show how much is done, now and then, and let other tasks and Ctrl-C take effect."""
        if time.monotonic() >= self._next_at:
            self._next_at = time.monotonic() + _REFRESH_SECONDS
            if not self._bar.disable:
                self._bar.update(self._task, completed=done, description=words())
            await asyncio.sleep(0)


@contextlib.contextmanager
def connections_logged() -> Generator[None]:
    """Write one line on stderr for each change of a client's connection, on either side."""
    handler = logging.StreamHandler(sys.stderr)
    level = LOG.level
    LOG.addHandler(handler)
    LOG.setLevel(logging.INFO)
    try:
        yield
    finally:
        LOG.removeHandler(handler)
        LOG.setLevel(level)


# -- figures --------------------------------------------------------------------------


def count(value: float) -> str:
    """Return the text of a count, or of a rate of counts."""
    return f"{value:,.0f}"


def counted(how_many: int, what: str) -> str:
    """Return a text such as "1 env", "16 envs" or "0 worker processes"."""
    plural = "es" if what.endswith("s") else "s"
    return f"{count(how_many)} {what}{'' if how_many == 1 else plural}"


def duration(microseconds: float | None) -> str:
    """Return the text of a time, in a unit that suits its size."""
    if microseconds is None:
        return "-"
    if microseconds < 1e3:
        return f"{microseconds:.0f} µs"
    if microseconds < 1e6:
        return f"{microseconds / 1e3:.1f} ms"
    return f"{microseconds / 1e6:.1f} s"
