"""The programs of pages on libraries that `make test` does not install run unchanged."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest
from run_python import output_of

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.simulators
@pytest.mark.parametrize(
    ("page", "needed"),
    [
        ("stable_baselines3", ["stable_baselines3"]),
        ("migrating#TorchRL", ["torchrl"]),
        ("migrating#RLlib", ["ray", "tree", "torch"]),
        ("migrating#RL Zoo", ["rl_zoo3"]),
        ("migrating#skrl", ["skrl"]),
        ("metrics", ["wandb", "prometheus_client"]),
    ],
)
def test_programs_run(
    page: str, needed: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each program of the page, or of its section, runs to its end, and they print something."""
    # Ray would join an existing cluster, such as that of other tests.
    monkeypatch.setenv("RAY_ADDRESS", "local")
    if missing := [name for name in needed if importlib.util.find_spec(name) is None]:
        pytest.skip(f"{', '.join(missing)} not installed")
    name, _, section = page.partition("#")
    text = (DOCS / f"{name}.md").read_text()
    if section:
        text = re.split(r"\n##", text.partition(f"# {section}\n")[2])[0]
    outputs = []
    for index, block in enumerate(
        re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    ):
        program = tmp_path / f"program_{index}.py"
        program.write_text(block)
        outputs.append(output_of(program, folder=tmp_path))
    assert "".join(outputs).strip()


@pytest.mark.simulators
@pytest.mark.parametrize(
    ("name", "needed"),
    [
        ("tianshou_env", "tianshou"),
        ("skyrl_env", "skyrl_gym"),
        ("lerobot_policy", "lerobot"),
        ("lerobot_dataset", "lerobot"),
    ],
)
def test_examples_for_other_libraries_run(name: str, needed: str) -> None:
    """Each runs to its end, and prints something."""
    pytest.importorskip(needed)
    assert output_of(DOCS.parent / "examples" / f"{name}.py").strip()


DYING = """
import os
import gymnasium as gym


class Dying(gym.Wrapper):
    steps = 0

    def step(self, action):
        self.steps += 1
        if self.steps == 250 and os.environ["DIES"] == "1":
            os._exit(3)
        return super().step(action)


def make():
    return Dying(gym.make("Pendulum-v1", max_episode_steps=200))


gym.register("Dying-v0", make)
"""


@pytest.mark.parametrize("dies", [False, True])
def test_cleanrls_loop_prints_no_return_of_a_lost_episode(
    dies: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its end may be the only one of a step, where there is no return at all."""
    monkeypatch.setenv("DIES", str(int(dies)))
    block = (DOCS.parent / "examples" / "cleanrl_loop.py").read_text()
    block = block.replace("Pendulum-v1", "Dying-v0").replace(
        "range(0, 1000, 4)", "range(0, 1700, 4)"
    )
    (tmp_path / "program.py").write_text(DYING + block)
    found = output_of(tmp_path / "program.py", folder=tmp_path).splitlines()
    returns = [float(line.rpartition("=")[2]) for line in found if "episodic_return" in line]
    assert len(returns) == (4 if dies else 8)
    assert max(returns) < 0
