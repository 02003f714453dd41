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
from typing import TextIO, cast

__all__ = ["main"]


def main() -> None:
    """Run the command that `sys.argv` names; the entry point of ``rlightning-aio``."""
    # A command catches Ctrl-C itself while envs run. At other times there is nothing to clean
    # up, and an exception could get lost in code that expects none.
    signal.signal(signal.SIGINT, _quit)
    warnings.showwarning = _say
    from rlightning_aio.errors import ConfigError  # noqa: PLC0415

    try:
        from rlightning_aio.cli.app import app  # noqa: PLC0415
        from rlightning_aio.cli.terminal import ResultStream  # noqa: PLC0415
        from rlightning_aio.hosts.standard_streams import stdout_set_aside  # noqa: PLC0415
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
        sys.stdout = sys.stderr


def _quit(*_: object) -> None:
    os._exit(130)


def _say(message: Warning | str, *_: object) -> None:
    """Show a warning without the line of code that raised it."""
    sys.stderr.write(f"warning: {message}\n")
