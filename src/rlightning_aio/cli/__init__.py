"""The command line: it parses, calls the library, and prints.

Rule: figures and tables go to stdout, everything said on the way to stderr; exit code 0
is success, 1 a failed env, 2 a wrong configuration or command line, 130 Ctrl-C.
Absent on purpose: rules of environments, and anything a program couldn't call itself.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import warnings

__all__ = ["main"]


def main() -> None:
    """Run the command that `sys.argv` names; the entry point of ``rlightning-aio``."""
    # Where envs run, a command catches Ctrl-C itself. Anywhere else there is nothing to
    # clean up, and an exception could get lost in code that expects none.
    signal.signal(signal.SIGINT, _quit)
    warnings.showwarning = _say
    from rlightning_aio.cli.app import app  # noqa: PLC0415
    from rlightning_aio.hosts.standard_streams import stdout_set_aside  # noqa: PLC0415

    sys.stdout = stdout_set_aside()
    if sys.stderr is None:  # pyright: ignore[reportUnnecessaryComparison]  # Closed by the caller.
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115  # To the end of the process.

    try:
        app()
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        # All is said; what the interpreter still does to end is not worth a traceback, and what is
        # printed then is no result.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        with contextlib.suppress(OSError):  # Nobody reads it any more.
            sys.stdout.flush()
        sys.stdout = sys.stderr


def _quit(*_: object) -> None:
    os._exit(130)


def _say(message: Warning | str, *_: object) -> None:
    """Show a warning as a user wants it, without the line of code that it came from."""
    sys.stderr.write(f"warning: {message}\n")
