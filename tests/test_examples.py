"""Each program in ``examples/``, in the README and in the documents runs as it stands.

Those that train, and so need torch, are run by examples/test_programs.py.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from patience import HANG

ROOT = Path(__file__).parent.parent
PROGRAMS = Path(__file__).with_name("programs.py")
LOOPS = ("async_loop", "sync_loop")


def blocks_of_python(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


def by_program(written: str) -> dict[str, str]:
    return dict(part.split("\n", 1) for part in written.split("\0")[1:])


def test_every_program_runs(tmp_path: Path) -> None:
    """It ends well, without a warning; the examples print something, and complain of nothing."""
    examples = [ROOT / "examples" / f"{name}.py" for name in LOOPS]
    programs = list(examples)
    # Those of docs/command-line.md and of the rest of docs/backends.md are no whole programs.
    backends = tmp_path / "callable.md"
    text = (ROOT / "docs" / "backends.md").read_text()
    backends.write_text(text.partition("\n## callable")[2].partition("\n## ")[0])
    pages = [
        ROOT / "docs" / f"{name}.md"
        for name in ("collecting", "evaluating", "gymnasium", "remote", "state")
    ]
    for page in (ROOT / "README.md", *pages, backends):
        blocks = [block for block in blocks_of_python(page) if "import torch" not in block]
        assert blocks
        for number, block in enumerate(blocks):
            program = tmp_path / f"{page.stem}_{number}.py"
            program.write_text(block)
            programs.append(program)
    # Asyncio's debug mode, which holds for tests, would log what takes longer than a blink.
    environment = {name: v for name, v in os.environ.items() if name != "PYTHONASYNCIODEBUG"}
    done = subprocess.run(
        [sys.executable, "-W", "error", PROGRAMS, *programs],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=HANG,
        check=False,
    )
    printed, complained = by_program(done.stdout), by_program(done.stderr)
    assert done.returncode == 0, list(complained.items())[-1]
    assert list(printed) == [str(program) for program in programs]
    for example in map(str, examples):
        assert printed[example]
        assert complained[example] == ""


def test_the_two_loops_are_short() -> None:
    """What shows how little it takes takes little: some fifteen lines that do something."""
    for name in LOOPS:
        lines = (ROOT / "examples" / f"{name}.py").read_text().splitlines()
        assert len([line for line in lines if line.strip()]) <= 17
