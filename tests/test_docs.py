"""Lists of arguments and settings, and programs for other libraries, in the documents.

The other programs of the documents are in test_examples.py.
"""

from __future__ import annotations

import inspect
import re
import shlex
from pathlib import Path

import pytest
from run_python import blocks, output_of

from rlightning_aio import EnvGroup, build_env_group
from rlightning_aio._core.hosts.env_server.settings import ServerSettings

DOCS = Path(__file__).parent.parent / "docs"
PROGRAMS = Path(__file__).with_name("programs.py")


def items(page: str) -> set[str]:
    """Return the names with which items of lists begin."""
    return set(re.findall(r"^- `(\w+)`", (DOCS / page).read_text(), re.MULTILINE))


def test_every_argument_and_setting_has_its_item() -> None:
    """No item is missing, and none is superfluous."""
    collecting = inspect.signature(EnvGroup.collect_async).parameters.keys() - {"self"}
    building = inspect.signature(build_env_group).parameters.keys() - {"env_cfgs"}
    assert items("collecting.md") - {"step_async"} == collecting | building
    assert items("remote.md") == set(ServerSettings.model_fields)


def run_programs(programs: list[str], folder: Path) -> str:
    files = [folder / f"{number}.py" for number in range(len(programs))]
    for file, program in zip(files, programs, strict=True):
        file.write_text(program)
    return output_of(PROGRAMS, *files, folder=folder, asyncio_debug=False)


def test_the_programs_for_rlightning_run(tmp_path: Path) -> None:
    """The script runs by the page's command, and the program that calls `install` by itself."""
    page = (DOCS / "rlightning.md").read_text()
    script, *programs = blocks("python", page)
    (command,) = blocks("sh", page)
    (tmp_path / "steps.py").write_text(script)
    assert "4 envs have made 200 steps" in output_of(
        *shlex.split(command)[1:], folder=tmp_path, asyncio_debug=False
    )
    run_programs(programs, tmp_path)


def test_the_programs_about_the_numbers_of_a_group_run(tmp_path: Path) -> None:
    """Means and percentiles are made, and a timeline is written, with the real libraries."""
    pytest.importorskip("prometheus_client")
    first, means, _, prometheus, traced = blocks("python", (DOCS / "metrics.md").read_text())
    printed = run_programs([first, means, prometheus, traced], tmp_path)
    assert re.search(r"mean return: [1-9]", printed)
    assert re.search(r"p99 of a step: \[\d\S* \d\S*\]", printed)
    for name in ("steps", "idle", "seconds_in_envs", "outcomes_env_died"):
        assert re.search(rf"^envs/{name} ", printed, re.MULTILINE)
        assert f'rlightning{{name="envs/{name}"}}' in printed
    assert (tmp_path / "run.json").stat().st_size > 0
