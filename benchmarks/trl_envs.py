"""TRL's GRPO with envs of its own, and with `rlightning_aio.trl`: resets, a hung tool, a death.

A step of training with a tiny model of random weights, whose tool calls are given, on the CPU: 32
rollouts whose resets take half a second each, then 4 of which one's tool hangs, then 4 of which
one's env ends its process.

    make .venv-trainers/installed
    .venv-trainers/bin/python benchmarks/trl_envs.py
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

from harness import machine_facts, machine_text

sys.path.append(str(Path(__file__).parents[1] / "tests"))

RESET_SECONDS, PATIENCE_SECONDS = 0.5, 60.0
CALLS: Final[dict[str, list[Any]]] = {
    "resets": [[("add", {"number": 1})]] * 32,
    "a hung tool": [[("add", {"number": 1})]] * 3 + [[("wait", {"seconds": 3600})]],
    "a killed env": [[("add", {"number": 1})]] * 3 + [[("die", {})]],
}


def train(way: str, what: str) -> None:
    """Take a step, and print the seconds of the resets and of the step, and the rewards."""
    from datasets import Dataset
    from trainers.envs import Adder
    from trainers.tiny import trainer_of

    from rlightning_aio.trl import Environments

    prompt = [{"role": "user", "content": "Add."}]
    seconds = RESET_SECONDS if what == "resets" else 0.0
    rows = Dataset.from_list([{"prompt": prompt, "seconds": seconds}] * 8)
    with tempfile.TemporaryDirectory() as folder:
        if way == "TRL":
            trainer = trainer_of(rows, CALLS[what], Path(folder), 1, environment_factory=Adder)
            report(trainer)
            return
        limits: dict[str, Any] = {"step_timeout": 1.0, "reset_timeout": 10.0}
        with Environments(Adder, num_envs=len(CALLS[what]), **limits) as environments:
            trainer = trainer_of(
                rows, CALLS[what], Path(folder), 1, environment_factory=environments
            )
            environments.join(trainer)
            report(trainer)


def report(trainer: Any) -> None:
    """Train, and print what was found."""
    found: dict[str, Any] = {}
    generate, score = trainer._generate_and_score_completions, trainer._calculate_rewards  # noqa: SLF001
    turn = trainer._generate_single_turn  # noqa: SLF001

    def watched(inputs: Any) -> Any:
        found["began"] = time.monotonic()
        return generate(inputs)

    def first_turn(*args: Any, **more: Any) -> Any:
        found.setdefault("resets", time.monotonic() - found["began"])
        return turn(*args, **more)

    def scored(*args: Any) -> Any:
        rewards = score(*args)
        values = rewards[:, 0].tolist()
        found["rewards"] = [None if math.isnan(value) else value for value in values]
        return rewards

    trainer._generate_and_score_completions = watched  # noqa: SLF001
    trainer._generate_single_turn = first_turn  # noqa: SLF001
    trainer._calculate_rewards = scored  # noqa: SLF001
    trainer.train()
    found["seconds"] = time.monotonic() - found.pop("began")
    print(json.dumps(found), flush=True)


def compared(what: str) -> dict[str, Any]:
    """Train both ways, each in a process of its own."""
    found: dict[str, Any] = {}
    for way in ("TRL", "rlightning_aio.trl"):
        command = [sys.executable, __file__, "--way", way, "--what", what]
        try:
            run = subprocess.run(
                command,
                capture_output=True,
                text=True,
                timeout=PATIENCE_SECONDS,
                env={**os.environ, "TRL_EXPERIMENTAL_SILENCE": "1"},
                check=False,
            )
        except subprocess.TimeoutExpired:
            found[way] = f"hung: given up after {PATIENCE_SECONDS:g} s"
            continue
        lines = [line for line in run.stdout.splitlines() if line.startswith('{"')]
        ended = f"the trainer ended with exit code {run.returncode}"
        found[way] = json.loads(lines[-1]) if run.returncode == 0 else ended
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--way", help=argparse.SUPPRESS)
    parser.add_argument("--what", help=argparse.SUPPRESS)
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    args = parser.parse_args()
    if args.way:
        train(args.way, args.what)
        return
    figures = {what: compared(what) for what in CALLS}
    if args.json:
        print(json.dumps(figures))
        return
    print(machine_text(machine_facts(("rlightning_aio", "trl", "torch", "transformers"))))
    for what, ways in figures.items():
        print(f"\n{what}")
        for way, found in ways.items():
            text = found
            if isinstance(found, dict):
                text = f"resets {found['resets']:.2f} s, step {found['seconds']:.1f} s"
                text += f", rewards {found['rewards'][-4:]}"
            print(f"  {way}: {text}")


if __name__ == "__main__":
    main()
