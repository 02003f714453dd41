"""Where a worker runs: its Python, environment variables, core and threads."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from rlightning_aio.sync import build_env_group

if TYPE_CHECKING:
    from pathlib import Path

    import pytest


def maker_of_witnesses() -> Any:
    """Return a maker of envs that describe their worker; it needs no module there."""

    class Witness(gym.Env[Any, Any]):
        observation_space = action_space = gym.spaces.Discrete(2)

        def variable(self, name: str) -> str | None:
            return os.environ.get(name)

        def seen_by(self, module: str) -> str | None:
            """Return what a module saw when it was imported."""
            return sys.modules[module].FOUND

    return Witness


def test_each_entry_has_its_own_surroundings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers use one thread for mathematics, whatever the trainer uses."""
    program = tmp_path / "python-of-another-environment"
    program.write_text(f'#!/bin/sh\nSTARTED_BY="$0" exec {sys.executable} "$@"\n')
    program.chmod(0o755)
    (tmp_path / "flavoured.py").write_text("import os\nFOUND = os.environ.get('FLAVOUR')\n")
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.setenv("FLAVOUR", "salt")
    witness = maker_of_witnesses()
    entries = [
        {
            "name": "plain",
            "task": witness,
            "num_workers": 2,
            "envs_per_process": 1,
        },
        {
            "name": "other",
            "task": witness,
            "interpreter": str(program),
            "env_vars": {"FLAVOUR": "sugar", "PYTHONPATH": str(tmp_path), "MKL_NUM_THREADS": "3"},
            "imports": ["flavoured"],
        },
    ]
    with build_env_group(entries) as group:
        one, _, other = (group[env_id] for env_id in group.env_ids)
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
            assert one.call("variable", name) == "1"
        assert one.call("variable", "FLAVOUR") == "salt"
        assert one.call("variable", "STARTED_BY") is None
        assert other.call("variable", "STARTED_BY") == str(program)
        assert other.call("seen_by", "flavoured") == "sugar"
        assert other.call("variable", "OMP_NUM_THREADS") == "1"
        assert other.call("variable", "MKL_NUM_THREADS") == "3", (
            "the configured values are in effect"
        )
    assert "flavoured" not in sys.modules
