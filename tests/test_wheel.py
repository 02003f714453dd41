"""The wheel and the sdist, which people install, work without the source tree."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from patience import HANG

ROOT = Path(__file__).parent.parent

PROGRAM = """
import sys

import gymnasium as gym
import numpy as np

import rlightning_aio
from rlightning_aio.sync import build_env_group
from rlightning_aio.vector import VectorEnv, make_vec

assert rlightning_aio.__file__.startswith(sys.prefix), rlightning_aio.__file__
pendulums = [lambda: gym.make("Pendulum-v1")] * 2
for envs in (VectorEnv(pendulums), make_vec("Pendulum-v1", 2, "async")):
    observations, _ = envs.reset(seed=1)
    assert envs.step(np.zeros((2, 1), np.float32))[0].shape == observations.shape == (2, 3)
    envs.close()
print("gymnasium")
with build_env_group(pendulums) as group:
    batch, _ = group.reset(seed=1)
    assert (batch.observation == observations).all()
print("factories")
"""


def run(*command: str | Path, folder: Path) -> str:
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=HANG, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


PIP = ("-m", "pip", "--quiet", "--disable-pip-version-check")


def found_python(version: str) -> Path | None:
    """Return the path of an interpreter: on PATH, or one of pyenv's."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    on_path = shutil.which(f"python{version}")
    candidates = [Path(on_path)] if on_path else []
    for python in [*candidates, *sorted(pyenv.glob(f"{version}.*/bin/python"))]:
        # A shim of pyenv may be for a version that is not selected.
        shown = subprocess.run([python, "--version"], capture_output=True, text=True, check=False)
        if shown.returncode == 0 and shown.stdout.startswith(f"Python {version}."):
            return python
    return None


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Build the sdist, and the wheel from it, as for publication."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--outdir", folder, ROOT, folder=folder)
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return {"wheel": wheel, "sdist": sdist}


@pytest.mark.pythons
@pytest.mark.timeout(1200)  # Pip fetches some 300 MB for each.
@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13", "3.14"])
def test_both_work_under_each_python(version: str, built: dict[str, Path], tmp_path: Path) -> None:
    """In an environment with nothing else installed; so does the command."""
    base = found_python(version)
    if base is None:
        pytest.skip(f"no Python {version} here")
    run(base, "-m", "venv", "empty", folder=tmp_path)
    folder = tmp_path / "empty" / "bin"
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    install = (folder / "python", *PIP, "install", "--constraint", ROOT / "constraints.txt")
    for package in (built["wheel"], built["sdist"]):
        run(*install, "--force-reinstall", "--no-deps", package, folder=tmp_path)
        run(*install, package, folder=tmp_path)
        run(folder / "python", *PIP, "check", folder=tmp_path)
        assert run(folder / "python", program, folder=tmp_path).split() == [
            "gymnasium",
            "factories",
        ]
    steps = ("rollout", ROOT / "configs" / "cartpole.yaml", "--steps", "500", "--json")
    assert '"steps"' in run(folder / "rlightning-aio", *steps, folder=tmp_path)
