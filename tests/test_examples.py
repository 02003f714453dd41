"""Each program in ``examples/``, in the README and in the documents runs unchanged.

New pages are found automatically. Programs that train, and so need torch, are run by
examples/test_programs.py, examples/agent.py and examples/http_env.py by examples/test_agent.py, the
trainer of remote.md, which needs a client, by cli/test_remote_commands.py.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from patience import HANG
from run_python import blocks, output_of

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PROGRAMS = Path(__file__).with_name("programs.py")
LOOPS = ("async_loop", "sync_loop")
RUN = (*LOOPS, "openpi_policy", "remote_arm")
# Run by other tests: they need other packages, or are not complete programs.
ELSEWHERE = {
    "command-line": "cli/test_documentation.py",
    "metrics": "test_docs.py",
    "rlightning": "test_docs.py",
    "simulators": "cli/test_simulators_page.py",
    "stable_baselines3": "vector/test_pages.py",
    "tutorial": "examples/test_tutorial.py",
}


def printed_on(page: Path) -> dict[str, str]:
    """Return what the page says that its programs print, where it shows that below them."""
    shown = r"^```python\n((?:(?!```).)*)^```\n+```text\n(.*?)^```"
    return dict(re.findall(shown, page.read_text(), re.MULTILINE | re.DOTALL))


def by_program(written: str) -> dict[str, str]:
    return dict(part.split("\n", 1) for part in written.split("\0")[1:])


# Those of migrating.md are run by vector/test_pages.py, that on Ray by on_ray/test_pages.py.
NEEDS_MORE = (
    r"^(import torch$|from stable_baselines3|net = "
    r"|from (lerobot|ray|rl_zoo3|skrl|torchrl|trl)\b"
    r"| +import gym_pusht|    \"placement\": \"ray\")"
)
PAGES = sorted(page for page in DOCS.rglob("*.md") if page.stem not in ELSEWHERE)


@pytest.mark.parametrize("pages", [[ROOT / "README.md"], *(PAGES[k::4] for k in range(4))], ids=len)
def test_every_program_runs(pages: list[Path], tmp_path: Path) -> None:
    """It ends without a warning, and prints what its page shows; the examples write no error."""
    examples = [ROOT / "examples" / f"{name}.py" for name in RUN if len(pages) == 1]
    programs = list(examples)
    shown: dict[str, str] = {}
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    for page in pages:
        for number, block in enumerate(blocks("python", page.read_text())):
            if re.search(NEEDS_MORE, block, re.MULTILINE):
                continue
            program = tmp_path / f"{page.stem}_{number}.py"
            program.write_text(block)
            programs.append(program)
            if block in (texts := printed_on(page)):
                shown[str(program)] = texts[block]
    # Without asyncio's debug mode, which logs every slow callback.
    environment = {name: v for name, v in os.environ.items() if name != "PYTHONASYNCIODEBUG"}
    done = subprocess.run(
        [sys.executable, "-W", "error", PROGRAMS, *programs],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=HANG,
        check=False,
    )
    printed, complained = by_program(done.stdout), by_program(done.stderr)
    assert done.returncode == 0, list(complained.items())[-1]
    assert list(printed) == [str(program) for program in programs]
    assert {program: printed[program] for program in shown} == shown
    for example in map(str, examples):
        assert printed[example]
        # On a busy machine, another placement may be the faster one.
        assert re.sub(r"entry .*`rlightning-aio bench` measures\n", "", complained[example]) == ""


def test_wrong_calls_raise_their_errors(tmp_path: Path) -> None:
    """Each call of the example is refused, and the group goes on."""
    printed = output_of("-W", "error", ROOT / "examples" / "errors.py", folder=tmp_path)
    assert [line.partition(":")[0] for line in printed.splitlines() if line[:1].isupper()] == [
        *("ConfigError", "StartFailed", "NothingPending", "UnknownEnv", "SnapshotError"),
        *("BadAction", "EnvBusy", "KeyboardInterrupt", "ResetNeeded", "GroupClosed"),
    ]


def test_omitted_pages_are_run_by_other_tests() -> None:
    """Each page exists, has a program, and is named by the test that runs it."""
    for page, test in ELSEWHERE.items():
        assert blocks("python", (DOCS / f"{page}.md").read_text())
        assert page in (ROOT / "tests" / test).read_text()


def test_the_two_loops_are_short() -> None:
    """At most 17 lines that are not empty."""
    for name in LOOPS:
        lines = (ROOT / "examples" / f"{name}.py").read_text().splitlines()
        assert len([line for line in lines if line.strip()]) <= 17
