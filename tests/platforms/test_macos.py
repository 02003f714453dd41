"""On Linux without what macOS lacks, everything that needs no worker process works."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
PROGRAM = HERE / "without_workers.py"
SCENARIOS = re.findall(r"^def (\w+)\(\) -> None:\n    \"", PROGRAM.read_text(), re.MULTILINE)


def test_it_works_as_on_macos(tmp_path: Path) -> None:
    """CI runs the same program on macOS itself."""
    command = [sys.executable, HERE / "as_on_macos.py", PROGRAM]
    surroundings = {name: value for name, value in os.environ.items() if "DEBUG" not in name}
    ended = subprocess.run(
        command, check=False, capture_output=True, text=True, cwd=tmp_path, env=surroundings
    )
    assert ended.returncode == 0, ended.stderr
    for scenario in SCENARIOS:
        assert f"{scenario}: works" in ended.stdout, ended.stdout + ended.stderr


def test_all_is_gone_that_macos_lacks(tmp_path: Path) -> None:
    """The surroundings of that program are as they say."""
    (tmp_path / "look.py").write_text("""
import ctypes, os, select, signal, socket, sys
assert sys.platform == "darwin"
for module, name in (
    (select, "epoll"), (os, "eventfd"), (os, "memfd_create"), (os, "pidfd_open"),
    (os, "sched_getaffinity"), (socket, "SOCK_SEQPACKET"), (signal, "SIGRTMIN"),
    (ctypes.CDLL(None), "prctl"),
):
    assert not hasattr(module, name), name
try:
    open("/proc/self/stat")
except FileNotFoundError:
    print("gone")
""")
    command = [sys.executable, HERE / "as_on_macos.py", tmp_path / "look.py"]
    ended = subprocess.run(command, check=False, capture_output=True, text=True)
    assert ended.stdout == "gone\n", ended.stderr
