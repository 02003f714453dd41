"""Runs programs one after another in this process, each as its `__main__`.

This saves an interpreter and its imports for each program, a second or more. The programs must
close what they start.

Run as: programs.py, then the programs' files. A line with a NUL and the file's name precedes the
output of each program, on stdout and stderr; an exception in a program ends the run.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

if __name__ == "__main__":
    for file in sys.argv[1:]:
        for stream in (sys.stdout, sys.stderr):
            print(f"\0{file}", file=stream, flush=True)
        # A new module, in which pickle finds the program's functions.
        main = sys.modules["__main__"] = ModuleType("__main__")
        main.__file__ = file
        exec(compile(Path(file).read_text(), file, "exec"), main.__dict__)
