"""Ways to play a fixed set of episodes: how long they take, and how busy the envs are.

``--part busy``: uneven episodes, and a policy that needs 20 ms for each batch; how busy the workers
are is the share of the time in which they step. At the end, with fewer episodes left than envs,
nothing can keep all workers busy, so few episodes give a lower share.

``--part metaworld`` (needs `rlightning-aio[metaworld]`): MetaWorld's 50 tasks, with its scripted
policies, 10 episodes each, in a plain loop, as which each episode must end; by a queue; dealt in
advance, task by task, to as many processes as the queue has workers, and as it has envs; and by
LeRobot's method (an `AsyncVectorEnv` for each task, whose finished envs wait for the last).

    python benchmarks/evaluation.py --part busy
    python benchmarks/evaluation.py --part metaworld
    python benchmarks/evaluation.py --part metaworld --tasks 3 --episodes 4 --way "a queue"
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
import warnings
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from rlightning_aio import sync
from rlightning_aio.evaluation import EpisodeSpec, Evaluation, evaluate

Outcome = tuple[float, int, bool]


class Uneven(gym.Env[Any, Any]):
    """An episode of 10 to 100 steps, each 10 ms long."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        del options
        super().reset(seed=seed)
        self._left = int(np.exp(self.np_random.uniform(np.log(10), np.log(100))))
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        del action
        time.sleep(0.010)
        self._left -= 1
        return np.zeros(1, np.float32), 1.0, self._left == 0, False, {}


def busy(num_workers: int, envs_each: int, episodes: int, min_results: int) -> None:
    """Print how busy the workers are while the policy takes 20 ms for each batch."""
    working = {"ns": 0, "batches": 0}

    def policy(batch: Any) -> Any:
        working["ns"] += int(batch.busy_ns.sum())
        working["batches"] += 1
        time.sleep(0.020)
        return np.zeros(len(batch), np.int64)

    entry = {
        "name": "uneven", "task": Uneven, "num_workers": num_workers * envs_each,
        "envs_per_process": envs_each,
    }  # fmt: skip
    specs = [EpisodeSpec("", seed) for seed in range(episodes)]
    with sync.build_env_group(entry) as group, group.auto_reset(1000):
        begun = time.perf_counter()
        found = evaluate(group, policy, specs, min_results=min_results)
        seconds = time.perf_counter() - begun
    steps = sum(one.length for one in found.attempts)
    share = working["ns"] / 1e9 / seconds / num_workers
    print(
        f"{episodes} episodes, {steps} steps, {num_workers} workers of {envs_each} envs: "
        f"{seconds:.1f} s, workers busy {share:.2f} of the time, "
        f"{steps / working['batches']:.1f} envs in a batch"
    )


# -- MetaWorld ----------------------------------------------------------------------------


def task_env(task: str) -> Any:
    """The env of the backend, on its own."""
    from rlightning_aio.envs.simulators.metaworld import MetaworldTask, _Options

    return MetaworldTask(task, _Options())


def policy_of(task: str) -> Any:
    from metaworld.policies import ENV_POLICY_MAP

    warnings.filterwarnings("ignore", message="Constant")
    return ENV_POLICY_MAP[task]()


def clipped(action: Any) -> Any:
    return np.clip(action, -1, 1).astype(np.float32)


def plain_loop(episodes: list[EpisodeSpec]) -> list[tuple[str, int, Outcome]]:
    """Play episodes one after another."""
    found: list[tuple[str, int, Outcome]] = []
    env, task = None, None
    for spec in episodes:
        if spec.task != task:
            env, task = task_env(spec.task), spec.task
        policy = policy_of(spec.task)
        observation, _ = env.reset(seed=spec.seed)
        total, length, over, success = 0.0, 0, False, False
        while not over:
            step = env.step(clipped(policy.get_action(observation)))
            observation, reward, terminated, truncated, info = step
            total, length, success = total + reward, length + 1, bool(info["success"])
            over = terminated or truncated
        found.append((spec.task, spec.seed, (total, length, success)))
    return found


def dealt(specs: list[EpisodeSpec], processes: int) -> list[tuple[str, int, Outcome]]:
    """Deal the episodes to processes in advance, task by task."""
    size = -(-len(specs) // processes)
    shards = [specs[k : k + size] for k in range(0, len(specs), size)]
    with multiprocessing.get_context("forkserver").Pool(processes) as pool:
        return [one for found in pool.map(plain_loop, shards, chunksize=1) for one in found]


def waiting_for_the_last(specs: list[EpisodeSpec]) -> list[tuple[str, int, Outcome]]:
    """Step all episodes of a task together until the last one ends, as LeRobot does."""
    found: list[tuple[str, int, Outcome]] = []
    for task in dict.fromkeys(spec.task for spec in specs):
        own = [spec for spec in specs if spec.task == task]
        envs = gym.vector.AsyncVectorEnv([partial(task_env, task)] * len(own), context="forkserver")
        policies = [policy_of(task) for _ in own]
        observations, _ = envs.reset(seed=[spec.seed for spec in own])
        total, length = np.zeros(len(own)), np.zeros(len(own), int)
        success, over = np.zeros(len(own), bool), np.zeros(len(own), bool)
        while not over.all():
            pairs = zip(policies, observations, strict=True)
            actions = clipped([policy.get_action(seen) for policy, seen in pairs])
            observations, rewards, terminated, truncated, info = envs.step(actions)
            total += np.where(over, 0, rewards)
            length += ~over
            success |= ~over & (np.asarray(info.get("success", 0)) > 0)
            over |= terminated | truncated
        envs.close()
        outcomes = zip(total.tolist(), length.tolist(), success.tolist(), strict=True)
        found += [(task, spec.seed, outcome) for spec, outcome in zip(own, outcomes, strict=True)]
    return found


def queued(
    specs: list[EpisodeSpec], num_workers: int, envs_each: int, min_results: int
) -> list[tuple[str, int, Outcome]]:
    """Play the episodes as a queue."""
    policies: dict[str, Any] = {}

    def policy(batch: Any) -> Any:
        env_ids = batch.env_ids()
        begins = np.flatnonzero(batch.is_reset).tolist()
        for row, info in zip(begins, batch.take(begins).info() if begins else (), strict=True):
            policies[env_ids[row]] = policy_of(info["task"])
        pairs = zip(env_ids, batch.observation, strict=True)
        return clipped([policies[env_id].get_action(seen) for env_id, seen in pairs])

    entry = {
        "name": "arm", "backend": "metaworld", "task": specs[0].task,
        "num_workers": num_workers * envs_each, "envs_per_process": envs_each,
    }  # fmt: skip
    with sync.build_env_group(entry) as group, group.auto_reset():
        found: Evaluation = evaluate(group, policy, specs, min_results=min_results)
    assert not found.failed, found.failed[0].outcome
    return [
        (one.spec.task, one.spec.seed, (one.reward or 0.0, one.length, bool(one.success)))
        for one in found.played
    ]


def metaworld(args: argparse.Namespace) -> None:
    """Print how long each way takes, and how many of its episodes end as in the first one."""
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    tasks = [*ALL_V3_ENVIRONMENTS][: args.tasks]
    specs = [EpisodeSpec(task, seed) for task in tasks for seed in range(args.episodes)]
    ways = {
        "plain loop": lambda: plain_loop(specs),
        "a queue": lambda: queued(specs, args.workers, args.envs_each, args.min_results),
        **{
            f"dealt to {count}": partial(dealt, specs, count)
            for count in (args.workers, args.workers * args.envs_each)
        },
        "waiting for the last": lambda: waiting_for_the_last(specs),
    }
    seconds: dict[str, float] = {}
    expected: dict[Any, Any] = {}
    for name, play in ways.items():
        if args.way is not None and name not in args.way:
            continue
        begun = time.perf_counter()
        found = {(task, seed): outcome for task, seed, outcome in play()}
        seconds[name] = time.perf_counter() - begun
        expected = expected or found
        equal = sum(outcome == expected[key] for key, outcome in found.items())
        rate = np.mean([success for _, _, success in found.values()])
        print(
            f"{name:22} {seconds[name]:6.1f} s  "
            f"success {rate:.1%}, {equal} of {len(specs)} episodes equal",
            flush=True,
        )
    if queue := seconds.pop("a queue", None):
        ratios = (f"{queue / other:.2f} of {name!r}" for name, other in seconds.items())
        print(f"a queue takes {', '.join(ratios)}")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--part", choices=("busy", "metaworld"), default="busy")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--envs-each", type=int, help="8, or 3 of MetaWorld")
    parser.add_argument("--min-results", type=int, help="half of the envs, unless given")
    parser.add_argument("--episodes", type=int, help="300, or 10 of each task")
    parser.add_argument("--tasks", type=int, default=50)
    parser.add_argument("--way", action="append", help="only this way to play MetaWorld's episodes")
    args = parser.parse_args()
    args.envs_each = args.envs_each or (8 if args.part == "busy" else 3)
    # One half of the envs step while the policy answers the other.
    args.min_results = args.min_results or args.workers * args.envs_each // 2
    args.episodes = args.episodes or (300 if args.part == "busy" else 10)
    if args.part == "busy":
        busy(args.workers, args.envs_each, args.episodes, args.min_results)
    else:
        metaworld(args)


if __name__ == "__main__":
    main()
