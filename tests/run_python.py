"""Runs a program in an interpreter of its own, as a reader of the documents would."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

from patience import HANG

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["output_of"]


def output_of(
    *arguments: str | Path, folder: Path | None = None, asyncio_debug: bool = True
) -> str:
    """What Python prints that is given these arguments, and that has to end well.

    Args:
        arguments: of the interpreter.
        folder: to run it in.
        asyncio_debug: keep asyncio's debug mode, which holds for tests, and logs what takes
            longer than a blink.
    """
    left_out = () if asyncio_debug else ("PYTHONASYNCIODEBUG",)
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={name: value for name, value in os.environ.items() if name not in left_out},
        capture_output=True,
        text=True,
        timeout=HANG,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
