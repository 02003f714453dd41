"""Runs programs in a new interpreter, as a reader of the documents does."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from typing import TYPE_CHECKING

from patience import HANG

if TYPE_CHECKING:
    from pathlib import Path


def blocks(language: str, page: str) -> list[str]:
    """Return the blocks of code in this language, in the text of a page."""
    return re.findall(rf"^```{language}\n(.*?)^```", page, re.MULTILINE | re.DOTALL)


def output_of(
    *arguments: str | Path, folder: Path | None = None, asyncio_debug: bool = True
) -> str:
    """Run Python with these arguments and return its output; it must exit with code 0.

    Args:
        arguments: of the interpreter.
        folder: to run it in.
        asyncio_debug: keep the debug mode of the tests, which logs every slow callback.
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
