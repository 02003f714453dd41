"""The runner of other projects' tests, on sources that this file writes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

RUN = Path(__file__).with_name("run.py")
OF_THE_INTERFACE = """
from gymnasium.vector import AsyncVectorEnv

def test_class_under_test():
    assert AsyncVectorEnv.__module__.startswith("rlightning_aio.")
"""


def run(sources: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, RUN, sources, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_a_missing_file_is_named_and_the_others_run(tmp_path: Path) -> None:
    """Sources of another version may lack one of a part's files."""
    tests = tmp_path / "gymnasium-1.4.0" / "tests"
    (tests / "vector").mkdir(parents=True)
    (tests / "vector" / "test_vector_env.py").write_text(OF_THE_INTERFACE)
    (tests / "wrappers").mkdir()
    (tests / "wrappers" / "test_normalize_observation.py").write_text("def test_it():\n    pass\n")
    done = run(tmp_path, "--only", "gymnasium")
    assert "the interface: 1 passed, 0 failed" in done.stdout, done.stdout + done.stderr
    assert "tests/vector/test_async_vector_env.py is missing" in done.stdout
    assert "its wrappers: 1 passed, 0 failed" in done.stdout
    assert done.returncode == 0


def test_a_file_that_fails_to_import_fails_the_run_and_absent_sources_do_not(
    tmp_path: Path,
) -> None:
    """Without any name, the projects run one after the other, and a summary follows."""
    tests = tmp_path / "RLightning" / "tests" / "unit"
    tests.mkdir(parents=True)
    (tests.parent / "conftest.py").touch()
    (tests / "test_registry.py").write_text("import rlightning.env\n\ndef test_it():\n    pass\n")
    (tests / "test_env_group_stats.py").write_text("import rlightning.no_such_module\n")
    done = run(tmp_path)
    assert "names of ours: 1 passed, 1 failed" in done.stdout, done.stdout + done.stderr
    assert done.stdout.endswith(
        "gymnasium: not run, for the reason above\nsb3: not run, for the reason above\n"
        "rlightning: failed\nrlightning-builder: not run, for the reason above\n"
    )
    assert done.returncode == 1
