"""``python -m rlightning_aio.legacy script.py …`` runs a script written for RLightning."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

from rlightning_aio.legacy import install


def main() -> None:
    """Run the script as Python itself would, with RLightning's names in place."""
    if len(sys.argv) < 2:
        sys.exit("usage: python -m rlightning_aio.legacy script.py [arguments of the script …]")
    del sys.argv[0]
    script = sys.argv[0]
    if not Path(script).is_file():
        sys.exit(f"{script}: no such file")
    # It replaces the current directory, which `-m` has put there.
    sys.path[0] = str(Path(script).resolve().parent)
    install()
    # `__file__` is absolute in a script that Python runs itself.
    runpy.run_path(str(Path(script).absolute()), run_name="__main__")


if __name__ == "__main__":
    main()
