"""A flood of connections leaves a process without descriptors for a while; no env is lost by it."""

from __future__ import annotations

from pathlib import Path

from run_python import output_of


def test_an_env_outlasts_a_flood_that_takes_every_descriptor() -> None:
    """Collecting goes on, and one restart is enough for the env that was killed meanwhile."""
    output = output_of(Path(__file__).with_name("flooded.py"))
    assert output.splitlines()[-1] == "['local-1'] True True"
