"""Runs programs in turn, all in this one process, each as its `__main__`.

For programs that close what they start: an interpreter and its imports for each of them, a
second and more, are left out.

Run as: programs.py, then the programs' files. A line of a NUL and the file's name begins what
each of them writes, to stdout and to stderr; what one of them raises ends the run.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

if __name__ == "__main__":
    for file in sys.argv[1:]:
        for stream in (sys.stdout, sys.stderr):
            print(f"\0{file}", file=stream, flush=True)
        # A module of its own, where its functions are looked for when they are pickled.
        main = sys.modules["__main__"] = ModuleType("__main__")
        main.__file__ = file
        exec(compile(Path(file).read_text(), file, "exec"), main.__dict__)
