"""What people install is the wheel: each of the changes of one line works with nothing else."""

from __future__ import annotations

import subprocess
import sys
import sysconfig
from importlib.util import find_spec
from pathlib import Path

import pytest
from patience import HANG

ROOT = Path(__file__).parent.parent

PROGRAM = """
import sys
from importlib.util import find_spec

import gymnasium as gym
import numpy as np

import rlightning_aio
from rlightning_aio.sync import build_env_group
from rlightning_aio.vector import VectorEnv, make_vec

assert rlightning_aio.__file__.startswith(sys.prefix), rlightning_aio.__file__
pendulums = [lambda: gym.make("Pendulum-v1")] * 2
for envs in (VectorEnv(pendulums), make_vec("Pendulum-v1", 2)):
    observations, _ = envs.reset(seed=1)
    assert envs.step(np.zeros((2, 1), np.float32))[0].shape == observations.shape == (2, 3)
    envs.close()
print("gymnasium")
if find_spec("stable_baselines3"):
    from rlightning_aio.sb3 import VecEnv

    envs = VecEnv(pendulums)
    envs.seed(1)
    assert (envs.reset() == observations).all()
    assert envs.step(np.zeros((2, 1), np.float32))[0].shape == (2, 3)
    envs.close()
    print("stable_baselines3")
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


@pytest.mark.simulators
def test_it_works_in_an_empty_environment(tmp_path: Path) -> None:
    """Installed with what it asks for; Stable-Baselines3 is lent, as it is large."""
    pip = ("-m", "pip", "--quiet", "--disable-pip-version-check")
    run(sys.executable, *pip, "wheel", "--no-deps", "--wheel-dir", ".", ROOT, folder=tmp_path)
    run(sys.executable, "-m", "venv", "empty", folder=tmp_path)
    python = tmp_path / "empty" / "bin" / "python"
    (wheel,) = tmp_path.glob("*.whl")
    run(python, *pip, "install", "--constraint", ROOT / "constraints.txt", wheel, folder=tmp_path)
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    assert run(python, program, folder=tmp_path).split() == ["gymnasium", "factories"]
    if find_spec("stable_baselines3") is None:
        pytest.skip("stable_baselines3 is not installed")
    lent = next((tmp_path / "empty" / "lib").glob("python*/site-packages")) / "lent.pth"
    lent.write_text(sysconfig.get_path("purelib"))
    assert "stable_baselines3" in run(python, program, folder=tmp_path)
