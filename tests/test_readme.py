"""Checks of the README and the page on configuration.

Commands are tested in cli/test_documentation.py, programs in test_examples.py.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
from pathlib import Path

import pytest
from patience import HANG

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
CONFIGURATION = (ROOT / "docs" / "configuration.md").read_text()


def blocks(language: str, page: str = README) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page, re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    return [line for block in blocks("sh") for line in block.splitlines() if line.strip()]


@pytest.mark.parametrize("command", [c for c in commands() if c.startswith("make")])
def test_every_make_target_exists(command: str) -> None:
    """Make has a target for each one in the README."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MAKE")}
    done = subprocess.run(
        [*shlex.split(command), "--dry-run"],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=HANG,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_the_page_on_configuration_names_every_field() -> None:
    """Each field of `EnvConfig` has its item, and no item names another."""
    from rlightning_aio import EnvConfig

    items = re.findall(r"^- (.*?): ", CONFIGURATION, re.MULTILINE)
    named = {
        name for item in items for name in re.findall(r"`(\w+)`", re.sub(r"\(.*?\)", "", item))
    }
    assert named == set(EnvConfig.model_fields)


def test_it_is_short() -> None:
    """A reader reads the whole README before going on."""
    assert len(README.split()) <= 700
