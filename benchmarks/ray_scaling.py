"""How many results can one trainer read from Ray actors, compared with worker processes?

    python benchmarks/ray_scaling.py
    python benchmarks/ray_scaling.py --actors 1 4 --envs 8 --floats 16 --seconds 1

Envs do no work, so that the trainer is the limit: ready envs are collected and stepped again. For
each number of actors, envs in each, and size of an observation: env steps per second, processor
time of the trainer's process (Ray's threads included) for one result, and megabytes of observations
per second. All actors are on this machine and share its cores with the trainer, so steps per second
are a lower bound; the processor time also holds for actors on other machines.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from harness import machine_facts, machine_text, say

from rlightning_aio import sync

PLACEMENTS = ("ray", "process")
WARM_UP_SECONDS = 0.3


def no_work(num_floats: int) -> type[gym.Env[Any, Any]]:
    """Make an env whose steps do nothing; defined here, so that it is pickled with its code."""

    class NoWork(gym.Env[Any, Any]):
        observation_space = gym.spaces.Box(-1, 1, (num_floats,), np.float32)
        action_space = gym.spaces.Box(-1, 1, (6,), np.float32)
        observation = np.zeros(num_floats, np.float32)

        def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
            return self.observation, {}

        def step(self, _: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            return self.observation, 0.0, False, False, {}

    return NoWork


def measured(
    placement: str, num_actors: int, num_envs: int, num_floats: int, seconds: float
) -> dict[str, Any]:
    """Measure one round of one setting."""
    entry = {
        "name": "none",
        "task": no_work(num_floats),
        "num_workers": num_actors * num_envs,
        "envs_per_process": num_envs,
        "placement": placement,
        **({"num_cpus": 0} if placement == "ray" else {}),
    }
    with sync.build_env_group(entry) as group:
        batch, _ = group.reset()
        group.step_async(batch.respond(action=np.zeros((len(batch), 6), np.float32)))
        _count(group, WARM_UP_SECONDS)
        busy, began = time.process_time(), time.perf_counter()
        count = _count(group, seconds)
        busy, took = time.process_time() - busy, time.perf_counter() - began
        group.collect_async(wait_all=True)
    return {
        "placement": placement,
        "actors": num_actors,
        "envs": num_envs,
        "bytes": 4 * num_floats,
        "steps_per_second": count / took,
        "cpu_us_per_result": 1e6 * busy / count,
        "megabytes_per_second": 4e-6 * num_floats * count / took,
    }


def _count(group: Any, seconds: float) -> int:
    until, count = time.perf_counter() + seconds, 0
    while time.perf_counter() < until:
        batch, _ = group.collect_async()
        group.step_async(batch.respond(action=np.zeros((len(batch), 6), np.float32)))
        count += len(batch)
    return count


def table(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| actors | envs in each | observation | placement | steps/s | CPU µs/result | MB/s |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['actors']} | {row['envs']} | {row['bytes']:,} B | {row['placement']} | "
        f"{row['steps_per_second']:,.0f} | {row['cpu_us_per_result']:.1f} | "
        f"{row['megabytes_per_second']:.1f} |"
        for row in rows
    ]
    return "\n".join(lines)


def main() -> None:
    import ray

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--actors", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--envs", type=int, nargs="+", default=[1, 8, 64], help="in each actor")
    parser.add_argument("--floats", type=int, nargs="+", default=[16, 1024, 21168])
    parser.add_argument("--seconds", type=float, default=3.0, help="of each setting")
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    ray.init(address="local", num_cpus=1, object_store_memory=2**29, include_dashboard=False)
    rows: list[dict[str, Any]] = []
    for num_actors, num_envs, num_floats in itertools.product(
        chosen.actors, chosen.envs, chosen.floats
    ):
        for placement in PLACEMENTS:
            rows.append(measured(placement, num_actors, num_envs, num_floats, chosen.seconds))
            say(table(rows[-1:]).splitlines()[-1])
    ray.shutdown()
    machine = machine_facts(["ray", "numpy"])
    say(f"\n{table(rows)}\n\n{machine_text(machine)}")
    if chosen.json:
        chosen.json.write_text(json.dumps({"rows": rows, "machine": machine}, indent=1) + "\n")


if __name__ == "__main__":
    main()
