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

__all__ = ["main"]


def main() -> None:
    """Run the command that `sys.argv` names; the entry point of ``rlightning-aio``."""
    # A command catches Ctrl-C itself while envs run. At other times there is nothing to clean
    # up, and an exception could get lost in code that expects none.
    signal.signal(signal.SIGINT, _quit)
    warnings.showwarning = _show_warning
    from rlightning_aio.errors import ConfigError  # noqa: PLC0415

    try:
        from rlightning_aio._core.hosts.descriptors import stdout_set_aside  # noqa: PLC0415
        from rlightning_aio.cli.app import app  # noqa: PLC0415

        sys.stdout = stdout_set_aside()
        app()
    except (ConfigError, OSError) as error:  # Environment variables that imports read; stdout.
        sys.stderr.write(f"error: {error}\n")
        sys.exit(2)
    finally:
        # The command has finished, so Ctrl-C while the interpreter exits is no interruption, and
        # what envs print then is no result.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        with contextlib.suppress(OSError):  # Its reader is gone, or the disk is full.
            sys.stdout.close()
        sys.stdout = sys.stderr


def _quit(*_: object) -> None:
    os._exit(130)


def _show_warning(message: Warning | str, *_: object) -> None:
    """Show a warning without the line of code that raised it."""
    sys.stderr.write(f"warning: {message}\n")
