"""PPO while one step in 2,000 raises, ends its process or hangs.

Stable-Baselines3's PPO learns to hold a particle that drifts, a task whose returns hardly differ
between seeds, with and without the faults, through `sb3.VecEnv`, `VectorEnv` and `Collector`. The
return is that of 100 episodes, without faults, of what was learned. The envs note each fault in a
file before it happens; counted are the outcomes in `group.metrics()`. Gymnasium's `AsyncVectorEnv`
is given the same envs, with one kind of fault at a time. With `--exceptions` nothing but exceptions
goes wrong, in one of 200 steps, and the envs are in the trainer's process.

    python benchmarks/faulty_training.py [--exceptions] [--steps 20000] [--seeds 3] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np
from harness import machine_facts, machine_text

SHARE, SHARE_OF_EXCEPTIONS = 1 / 2000, 1 / 200
KINDS: Final = {"raises": "env_raised", "dies": "env_died", "hangs": "env_hung"}
NUM_ENVS, NUM_STEPS, EPISODES = 8, 32, 100
PATIENCE_SECONDS: Final = 120.0
WAYS = ("sb3.VecEnv", "VectorEnv", "Collector")
SETTINGS: Final[dict[str, Any]] = {
    "batch_size": 256,
    "n_epochs": 20,
    "gamma": 0.98,
    "gae_lambda": 0.8,
    "learning_rate": lambda left: 0.001 * left,
    "clip_range": lambda left: 0.2 * left,
}


class Drift(gym.Env[Any, Any]):
    """A particle that is pushed left or right, and drifts; a step earns more near the middle.

    It is lost ten places from there. A policy that pushes it back earns 90 in 100 steps, and random
    actions lose it after some 40.
    """

    observation_space = gym.spaces.Box(-2, 2, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed, options=options)
        self.place, self.steps = int(self.np_random.integers(-8, 9)), 0
        return self._observed(), {}

    def step(self, action: Any) -> Any:
        self.place += (1 if action else -1) + int(self.np_random.integers(-1, 2))
        self.steps += 1
        is_lost = abs(self.place) >= 10
        reward = 0.0 if is_lost else 1 - abs(self.place) / 10
        return self._observed(), reward, is_lost, self.steps == 100 and not is_lost, {}

    def _observed(self) -> Any:
        return np.array([self.place / 10], np.float32)


class Faulty(gym.Wrapper[Any, Any, Any, Any]):
    """Some of its steps go wrong, after a line in a file; which is drawn from the system."""

    def __init__(self, env: Any, kinds: list[str], share: float, log: str) -> None:
        super().__init__(env)
        self.kinds, self.share, self.log = kinds, share, log
        self.rng = random.SystemRandom()

    def step(self, action: Any) -> Any:
        if self.kinds and self.rng.random() < self.share:
            fault = self.rng.choice(self.kinds)
            with open(self.log, "a") as file:  # noqa: PTH123  # Lines of several processes.
                file.write(f"{KINDS[fault]}\n")
            if fault == "raises":
                raise RuntimeError("a fault")
            if fault == "dies":
                os._exit(3)
            time.sleep(3600)
        return self.env.step(action)


def faulty(kinds: list[str], share: float, log: str) -> Any:
    return Faulty(Drift(), kinds, share, log)


def learner_of(way: str, make: Any, seed: int, *, inline: bool) -> tuple[Any, Any]:
    """PPO on 8 envs, and their group if they have one."""
    from gymnasium.vector import AsyncVectorEnv, AutoresetMode
    from learner_of_collector import LearnerOfCollector
    from stable_baselines3 import PPO

    from rlightning_aio import sb3, sync
    from rlightning_aio.vector import VectorEnv

    same_step: Any = {"autoreset_mode": AutoresetMode.SAME_STEP}
    where = {"placement": "inline"} if inline else {"step_timeout": 3, "envs_per_process": 1}
    fields: dict[str, Any] = {"on_env_error": "restart", **where}
    given: dict[str, Any] = {"n_steps": NUM_STEPS, "seed": seed, "device": "cpu", **SETTINGS}
    if way == "Collector":
        group = sync.build_env_group(make, num_workers=NUM_ENVS, name="env", **fields)
        group.init()
        return LearnerOfCollector(group, Drift, NUM_STEPS * NUM_ENVS, **given), group
    if way == "sb3.VecEnv":
        envs: Any = sb3.VecEnv([make] * NUM_ENVS, **fields)
    elif way == "VectorEnv":
        envs = VectorEnv([make] * NUM_ENVS, **same_step, **fields)
    else:
        envs = AsyncVectorEnv([make] * NUM_ENVS, **same_step)
    wrapped = envs if way == "sb3.VecEnv" else sb3.VecEnv(envs)
    return PPO("MlpPolicy", wrapped, **given), getattr(envs, "group", None)


def train(way: str, kinds: list[str], seed: int, steps: int, *, exceptions: bool) -> dict[str, Any]:
    """Return what was learned, and the faults."""
    import torch
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    torch.set_num_threads(1)
    with tempfile.NamedTemporaryFile("r") as log:
        share = SHARE_OF_EXCEPTIONS if exceptions else SHARE
        make = partial(faulty, kinds, share, log.name)
        learner, group = learner_of(way, make, seed, inline=exceptions)
        learner.learn(steps)
        injected = Counter(log.read().split())
    counted: dict[str, int] = {}
    if group is not None:
        metrics = group.metrics()
        counted = {kind: int(metrics[f"envs/outcomes_{kind}"]) for kind in KINDS.values()}
        group.close()
    fresh = make_vec_env(Drift, EPISODES, seed=seed)
    mean, _ = evaluate_policy(learner, fresh, EPISODES, deterministic=False)
    return {"return": mean, "injected": {k: injected[k] for k in counted}, "counted": counted}


def run(way: str, kinds: list[str], seeds: int, steps: int, *, exceptions: bool = False) -> Any:
    """Train in a process of its own, with one seed after the other."""
    command = [sys.executable, __file__, "--way", way, "--kinds", *kinds]
    command += ["--seeds", str(seeds), "--steps", str(steps), *["--exceptions"] * exceptions]
    limit = None if way in WAYS else PATIENCE_SECONDS
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder, "errors")
        with (
            written.open("w") as errors,
            subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=errors, text=True, start_new_session=True
            ) as process,
        ):
            try:
                printed, _ = process.communicate(timeout=limit)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, 9)
                return f"hung: given up after {limit:g} s"
        if process.returncode == 0:
            return [json.loads(line) for line in printed.splitlines()]
        return f"ended by {written.read_text().strip().splitlines()[-1]}"


def row(way: str, name: str, found: list[dict[str, Any]]) -> str:
    """A line of the table."""
    returns = [one["return"] for one in found]
    counts = {
        what: sum((Counter(one[what]) for one in found), Counter[str]())
        for what in ("injected", "counted")
    }
    cells = [f"{value:.1f}" for value in sorted(returns)]
    cells = [", ".join(cells), f"{statistics.fmean(returns):.1f}"]
    for count in counts.values():
        cells.append(", ".join(str(count[kind]) for kind in KINDS.values()))
    return f"| {way}, {name} | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--exceptions", action="store_true", help="many of them, nothing else")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    parser.add_argument("--way", help=argparse.SUPPRESS)
    parser.add_argument("--kinds", nargs="*", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.way:
        for seed in range(args.seeds):
            found = train(args.way, args.kinds, seed, args.steps, exceptions=args.exceptions)
            print(json.dumps(found), flush=True)
        return
    cases = {"no faults": [], "faults": ["raises"] if args.exceptions else [*KINDS]}
    report = {
        way: {
            name: run(way, kinds, args.seeds, args.steps, exceptions=args.exceptions)
            for name, kinds in cases.items()
        }
        for way in WAYS
    }
    peers = [] if args.exceptions else KINDS
    peer = {kind: run("AsyncVectorEnv", [kind], 1, args.steps) for kind in peers}
    if args.json:
        print(json.dumps(report | {"AsyncVectorEnv": peer}))
        return
    print("| | returns | mean | injected: raised, died, hung | counted |\n|---|---|---|---|---|")
    for way, found in report.items():
        for name, seeds in found.items():
            print(seeds if isinstance(seeds, str) else row(way, name, seeds))
    for kind, end in peer.items():
        print(f"AsyncVectorEnv, one {kind}: {end}")
    packages = ("rlightning_aio", "gymnasium", "stable-baselines3", "torch")
    print(machine_text(machine_facts(packages)))


if __name__ == "__main__":
    main()
