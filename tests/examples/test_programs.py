"""Each example that trains runs as a reader would run it, for a few updates, and goes on."""

from __future__ import annotations

import csv
import importlib
import re
import signal
from pathlib import Path
from typing import Any

import pytest
from run_python import blocks, output_of
from timelines import Seen

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.simulators

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
SHORT = {
    "ppo": "--task CartPole-v1 --num-steps 32",
    "ppo_async": "--task CartPole-v1 --num-steps 32",
    "ppo_overlap": "--num-envs 2 --envs-each 2 --min-results 1 --num-steps 32 --epochs 1",
    "sac": "--num-envs 4 --min-results 2 --learning-starts 240 --record-every 32 --hidden 16",
}


def curve(folder: Path) -> list[dict[str, str]]:
    with (folder / "curve.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("name", SHORT)
def test_example_trains_and_resumes(name: str, tmp_path: Path) -> None:
    """Its curve grows by a row for each update, and a second run goes on where it ended."""
    program = EXAMPLES / f"{name}.py"
    given = [*SHORT[name].split(), "--folder", str(tmp_path), "--total-steps"]
    traced = ["--trace", str(tmp_path / "run.json")] if name.startswith("ppo") else []
    assert "'steps': " in output_of(
        "-W", "error", program, *given, "256", *traced, asyncio_debug=False
    )
    assert not traced or Seen(tmp_path / "run.json").called("learner")
    first = curve(tmp_path)
    assert int(first[-1]["steps"]) >= 256
    output_of(program, *given, "512", "--resume", asyncio_debug=False)
    both = curve(tmp_path)
    assert both[: len(first)] == first
    assert int(both[-1]["steps"]) >= 512
    seconds = [float(row["seconds"]) for row in both]
    assert seconds == sorted(seconds)


def test_what_was_learned_is_evaluated(tmp_path: Path) -> None:
    """Each environment plays as many episodes as were asked for, by the checkpoint's weights."""
    given = [*SHORT["ppo_async"].split(), "--total-steps", "256", "--folder", tmp_path]
    output_of(EXAMPLES / "ppo_async.py", *given, asyncio_debug=False)
    asked = ["--folder", tmp_path, "--num-envs", "3", "--episodes", "2"]
    printed = output_of("-W", "error", EXAMPLES / "evaluate.py", *asked, asyncio_debug=False)
    assert re.match(r"6 episodes: return \d+\.\d \+- \d+\.\d", printed)


@pytest.mark.parametrize("preset", ["Args", "CartPole"])
def test_a_run_that_ctrl_c_ended_resumes_as_if_it_had_not(
    preset: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It ends after the update, with the same weights and curve in the end, amid episodes."""
    monkeypatch.syspath_prepend(EXAMPLES)
    ppo = importlib.import_module("ppo")
    before, learn = signal.getsignal(signal.SIGINT), ppo.learn

    def train(folder: str, **options: bool) -> dict[str, Any]:
        short = {"num_envs": 3, "num_steps": 40, "num_minibatches": 4, "epochs": 1}
        folder = str(tmp_path / folder)
        ppo.train(getattr(ppo, preset)(total_steps=480, folder=folder, **short, **options))
        return torch.load(Path(folder) / "checkpoint.pt", weights_only=True)

    def interrupted(*given: Any) -> dict[str, float]:
        signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is before
        return learn(*given)

    through = train("through")
    monkeypatch.setattr(ppo, "learn", interrupted)
    assert train("twice")["run"]["steps"] == 120
    assert signal.getsignal(signal.SIGINT) is before
    monkeypatch.setattr(ppo, "learn", learn)
    resumed = train("twice", resume=True)
    for name, value in through["agent"].items():
        assert torch.equal(resumed["agent"][name], value), name
    curves = [
        [{k: v for k, v in row.items() if "seconds" not in k} for row in saved["run"]["rows"]]
        for saved in (through, resumed)
    ]
    assert repr(curves[0]) == repr(curves[1])


def test_grpo_learns() -> None:
    """Rewards grow from about 1.4 of 3 to nearly all."""
    printed = output_of("-W", "error", EXAMPLES / "grpo.py", asyncio_debug=False)
    assert float(printed.split()[-1]) > 2.5


def test_the_program_of_the_training_page_learns(tmp_path: Path) -> None:
    """It is complete, runs as it stands (with fewer updates), and is short."""
    text = (ROOT / "docs" / "training.md").read_text()
    section = text.partition("## A complete asynchronous PPO")[2]
    (block,) = blocks("python", section.partition("\n## ")[0])
    assert len(block.splitlines()) <= 75
    program = tmp_path / "program.py"
    program.write_text(
        block.replace(
            "UPDATES, TRANSITIONS, EPOCHS = 60, 1024,",
            "UPDATES, TRANSITIONS, EPOCHS = 10, 256,",
        )
    )
    assert "steps to an episode" in output_of("-W", "error", program, asyncio_debug=False)
