"""The command line: it parses, calls the library, and prints.

Rule: results go to stdout, all other messages to stderr. Exit code 0 is success, 1 a failed env,
2 a wrong configuration or command line, 130 Ctrl-C. Everything that a program could need is in the
library, not here.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import warnings
from typing import Final, NoReturn, TextIO, cast

__all__ = ["main", "show_warning"]

_end_process: Final = os._exit
_PID: Final = os.getpid()


def main() -> None:
    """Run the command that `sys.argv` names; the entry point of ``rlightning-aio``."""
    # A command catches Ctrl-C itself while envs run. At other times there is nothing to clean
    # up, and an exception could get lost in code that expects none.
    signal.signal(signal.SIGINT, _quit)
    os._exit = _quit_by_env
    warnings.showwarning = show_warning
    from rlightning_aio.errors import ConfigError  # noqa: PLC0415

    try:
        from rlightning_aio._core.hosts.standard_streams import stdout_set_aside  # noqa: PLC0415
        from rlightning_aio.cli.app import app  # noqa: PLC0415
        from rlightning_aio.cli.terminal import ResultStream  # noqa: PLC0415
    except ConfigError as error:  # Of the environment variables that imports read.
        sys.stderr.write(f"error: {error}\n")
        sys.exit(2)
    sys.stdout = cast("TextIO", ResultStream(stdout_set_aside()))
    if sys.stderr is None:  # pyright: ignore[reportUnnecessaryComparison]  # Closed by the caller.
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115  # To the end of the process.

    try:
        try:
            app()
        finally:
            # The command has finished, so Ctrl-C while the interpreter exits is no interruption.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            with contextlib.suppress(BrokenPipeError):  # Its reader is gone.
                sys.stdout.flush()
    except KeyboardInterrupt:
        sys.exit(130)
    except ConfigError as error:  # Outside any command, as in --help.
        sys.stderr.write(f"error: {error}\n")
        sys.exit(2)
    finally:
        os._exit = _end_process
        sys.stdout = sys.stderr


def _quit(*_: object) -> None:
    _end_process(130)


def _quit_by_env(status: int) -> NoReturn:
    """End the process as `os._exit` does, but never as if the command had succeeded."""
    if os.getpid() != _PID:  # A process that an env has forked.
        _end_process(status)
    sys.stderr.write(
        f"error: os._exit({status}) was called in the process of this command, so there is no "
        "result; under `placement: process`, an env ends a worker, which is reported and replaced\n"
    )
    _end_process(status or 1)


def show_warning(message: Warning | str, *_: object) -> None:
    """Show a warning without the line of code that raised it."""
    sys.stderr.write(f"warning: {message}\n")
