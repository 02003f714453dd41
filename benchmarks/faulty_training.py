"""PPO on CartPole while one step in 2,000 raises, ends its process or hangs.

Stable-Baselines3's PPO trains through `sb3.VecEnv` and through `VectorEnv`, with and without the
faults; the return is the mean of the last 100 episodes. Gymnasium's `AsyncVectorEnv` is given the
same envs.

    python benchmarks/faulty_training.py [--steps 30000] [--seeds 3] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import time
from functools import partial
from typing import Any, Final

import gymnasium as gym
import numpy as np
from harness import machine_facts, machine_text

SHARE: Final = 1 / 2000
NUM_ENVS, PATIENCE_SECONDS = 8, 120.0
WAYS = ("sb3.VecEnv", "VectorEnv", "AsyncVectorEnv")


class Faulty(gym.Wrapper[Any, Any, Any, Any]):
    """Some of its steps raise, end the process or hang; which is drawn from the system."""

    def __init__(self, env: Any, share: float) -> None:
        super().__init__(env)
        self.share, self.rng = share, random.SystemRandom()

    def step(self, action: Any) -> Any:
        if self.rng.random() < self.share:
            fault = self.rng.choice(("raise", "die", "hang"))
            if fault == "raise":
                raise RuntimeError("a fault")
            if fault == "die":
                os._exit(3)
            time.sleep(3600)
        return self.env.step(action)


def pole(share: float) -> Any:
    return Faulty(gym.make("CartPole-v1"), share)


def envs_of(way: str, share: float) -> Any:
    """The envs as a `VecEnv`, and their group if they have one."""
    from gymnasium.vector import AsyncVectorEnv, AutoresetMode

    from rlightning_aio import sb3
    from rlightning_aio.vector import VectorEnv

    makers = [partial(pole, share)] * NUM_ENVS
    fields: dict[str, Any] = {"step_timeout": 2, "on_env_error": "restart", "envs_per_process": 1}
    if way == "sb3.VecEnv":
        envs = sb3.VecEnv(makers, **fields)
        return envs, envs.group
    if way == "VectorEnv":
        envs = VectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP, **fields)
        return sb3.VecEnv(envs), envs.group
    return sb3.VecEnv(AsyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)), None


def train(way: str, share: float, seed: int, steps: int) -> None:
    """Train, and print the return and the failures by kind."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor

    torch.set_num_threads(1)
    envs, group = envs_of(way, share)
    model = PPO("MlpPolicy", VecMonitor(envs), n_steps=128, seed=seed, device="cpu")
    model.learn(steps)
    buffer: Any = model.ep_info_buffer
    found = {"return": float(np.mean([one["r"] for one in buffer]))}
    if group is not None:
        kinds = {key.removeprefix("envs/outcomes_"): n for key, n in group.metrics().items()}
        found |= {kind: kinds[kind] for kind in ("env_raised", "env_died", "env_hung")}
    print(json.dumps(found), flush=True)
    os._exit(0)


def run(way: str, share: float, seed: int, steps: int) -> Any:
    """Train in a process of its own."""
    command = [sys.executable, __file__, "--way", way, "--share", str(share)]
    command += ["--seed", str(seed), "--steps", str(steps)]
    try:
        ended = subprocess.run(
            command, capture_output=True, text=True, timeout=PATIENCE_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return f"hung: given up after {PATIENCE_SECONDS:g} s"
    lines = [line for line in ended.stdout.splitlines() if line.startswith('{"')]
    if ended.returncode == 0 and lines:
        return json.loads(lines[-1])
    return f"ended by {ended.stderr.strip().splitlines()[-1]}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=30_000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    for hidden, kind in (("--way", str), ("--share", float), ("--seed", int)):
        parser.add_argument(hidden, type=kind, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.way:
        train(args.way, args.share, args.seed, args.steps)
    report = {
        f"{way}, {name}": [run(way, share, seed, args.steps) for seed in range(args.seeds)]
        for way in WAYS
        for name, share in (("no faults", 0.0), ("faults", SHARE))
        if way != "AsyncVectorEnv" or share
    }
    if args.json:
        print(json.dumps(report))
        return
    packages = ("rlightning_aio", "gymnasium", "stable-baselines3", "torch")
    print(machine_text(machine_facts(packages)))
    for what, found in report.items():
        print(f"\n{what}")
        for one in found:
            print(f"  {one}")


if __name__ == "__main__":
    main()
