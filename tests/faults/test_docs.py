"""The page on faults is true: its example runs."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from patience import HANG

PAGE = Path(__file__).parents[2] / "docs" / "faults.md"


def test_example_of_handling_faults_runs() -> None:
    """The only block of Python on the page, run as a script."""
    (example,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", example],
        capture_output=True,
        text=True,
        timeout=HANG,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert not run.stderr
