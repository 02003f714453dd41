"""``rlightning-aio check`` builds and steps one env of each entry and prints its spaces.

With ``--steps`` it plays episodes with random actions, and looks for what is wrong with an env:
rewards that are no numbers, observations that don't fit their space, results that a seed doesn't
repeat, and what each episode leaves behind. Left out: what a group refuses anyway, such as
observations of another shape.
"""

from __future__ import annotations

import math
import os
import pickle
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, cast

import gymnasium as gym
import numpy as np
import typer

import rlightning_aio
from rlightning_aio._core.group.api.facade import ensure_auto_reset
from rlightning_aio._core.hosts.processes import resident_mb
from rlightning_aio.batch.parts import all_agents, summed_rewards
from rlightning_aio.cli.options import AsJson, Config, Overrides
from rlightning_aio.cli.policies import Responder, respond_to_all
from rlightning_aio.cli.terminal import (
    counted,
    duration,
    print_json,
    print_lines,
    run_interruptible,
)
from rlightning_aio.config import check_installed, load_config, moved
from rlightning_aio.config.documents import parse_configs
from rlightning_aio.errors import ConfigError
from rlightning_aio.policies.random_actions import allowed_action, sampler_of
from rlightning_aio.protocol.columns import held, in_brackets, out_of_bounds
from rlightning_aio.trees import as_numpy, index, tree_of, walked
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Iterator, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.config import EnvConfig

_STEPS: Final = 3
_REPEATED: Final = 100
"""Most steps that are done twice with the same seed."""
_LOOKED_AT: Final = 20
"""Most results whose observations are compared with their space."""
_MEMORY: Final = "MB of memory"
_SLACK_MB: Final = 16.0
"""Memory that caches may take between the second episode and the last."""
_NUMBERS: Final[Any] = (
    gym.spaces.Box, gym.spaces.Discrete, gym.spaces.MultiBinary, gym.spaces.MultiDiscrete,
)  # fmt: skip


@dataclass
class _Finding:
    """The findings about an entry; None where its env was not started.

    Attributes:
        skipped: the reason why it was not started.
        steps: how many steps it made; none if only a policy can choose its actions.
        is_played: with ``--steps``; episodes: number that have ended then; step_us: median time of
            a step in its env.
        problems: in words, each with what to do.
        leaks: memory grows, and `recycle` helps; is_random: a seed does not repeat its results.
    """

    name: str
    backend: str
    task: str
    num_workers: int
    num_envs: int
    observation_space: str | None = None
    action_space: str | None = None
    max_episode_steps: int | None = None
    skipped: str | None = None
    steps: int = 0
    is_played: bool = False
    episodes: int = 0
    step_us: float | None = None
    problems: list[str] = field(default_factory=list[str])
    leaks: bool = False
    is_random: bool = False


def check(
    config: Config,
    overrides: Overrides = None,
    steps: Annotated[
        int, typer.Option(min=0, help="Play this many steps with random actions, and look closely.")
    ] = 0,
    as_json: AsJson = False,
) -> None:
    """Check a config: build one env of each entry, step it a few times, print its spaces.

    Errors in the file are reported first, before anything is started. Robots are not
    started, and neither are env_servers, whose envs live elsewhere. If --steps finds anything
    wrong with an env, the exit code is 1.

    For example:

        rlightning-aio check configs/cartpole.yaml
        rlightning-aio check configs/halfcheetah.yaml envs.0.task=Ant-v5
        rlightning-aio check configs/cartpole.yaml --steps 2000
    """
    configs = load_config(config, overrides or ())
    check_installed(configs)
    findings: list[_Finding] = []
    run_interruptible(_look(configs, findings, steps))
    if as_json:
        print_json({"config": str(config), "entries": [asdict(found) for found in findings]})
    else:
        print_lines(line for found in findings for line in _lines(found))
    if any(found.problems for found in findings):
        raise typer.Exit(1)


async def _look(configs: Sequence[EnvConfig], findings: list[_Finding], steps: int) -> None:
    for config in configs:
        found = _Finding(
            config.name, config.backend, config.task_name, config.num_workers, config.num_envs
        )
        if config.backend == "env_server":
            found.skipped = "its envs live with its clients"
        elif config.is_hardware:
            found.skipped = "it would move"
        else:
            await _try(config, found, steps)
        findings.append(found)


async def _try(config: EnvConfig, found: _Finding, steps: int) -> None:
    """Build one env of the entry and step it."""
    alone: dict[str, Any] = {"num_workers": 1, "recycle": {}}
    # A replacement would hide what is wrong.
    raising = {"on_env_error": "raise", "on_worker_death": "raise"}
    one = moved(config.model_copy(update=alone | raising), config.placement)
    async with rlightning_aio.build_env_group([one]) as group:
        (meta,) = group.metas
        found.observation_space = str(meta.observation_space)
        found.action_space = str(meta.action_space)
        found.num_envs = meta.num_envs
        found.max_episode_steps = config.max_episode_steps or meta.max_episode_steps
        if _has_no_samples(meta.action_space):
            await group.reset(seed=0)
            return
        with ensure_auto_reset(group):
            async for _ in _results(group, _STEPS, seed=0):
                pass
            found.steps = _STEPS
            if steps:
                await _play(config, group, steps, found)
                await _repeat(group, min(steps, _REPEATED), found)
        if steps:
            await _compare_spaces(group, min(steps, _LOOKED_AT), found)
    if steps and (config.recycle or found.leaks) and not found.is_random:
        await _renew(one, found)


async def _results(group: EnvGroup, steps: int, seed: int) -> AsyncGenerator[BatchedData]:
    """Yield the results of a reset, and of steps with random actions, the same each time."""
    respond = Responder(group, None, 0)
    batch, _ = await group.reset(seed=seed)
    yield batch
    for _ in range(steps):
        await respond_to_all(group, respond, batch)
        batch, _ = await group.collect_async()
        yield batch


def _has_no_samples(space: Any) -> bool:
    """Return True for actions that are plain Python values."""
    try:
        space.sample()
    except NotImplementedError:
        return True
    return False


# -- what is wrong with an env ----------------------------------------------------------


async def _play(config: EnvConfig, group: EnvGroup, steps: int, found: _Finding) -> None:
    """Play `steps` steps, and look at rewards, at times, and at what episodes leave behind."""
    (worker,) = group.get_workers()
    pid, samples, times = worker["pid"] or os.getpid(), list[dict[str, float]](), list[int]()
    rewards = bad = 0
    async for batch in _results(group, steps, seed=0):
        stepped = ~batch.is_reset
        of_steps = summed_rewards(batch.reward)[stepped]
        rewards, bad = rewards + of_steps.size, bad + np.count_nonzero(~np.isfinite(of_steps))
        times += batch.busy_ns.tolist() if stepped.all() else []
        samples += [_held(pid)] * int(np.count_nonzero(all_agents(batch.done) & stepped))
    found.is_played, found.episodes = True, len(samples)
    found.step_us = float(np.median(times)) / 1e3 if times else None
    if bad:
        found.problems.append(f"{bad} of {rewards} rewards are NaN or infinite")
    can_recycle = _can_recycle(config)
    leaks = _leaks(samples, can_recycle=can_recycle)
    found.problems += leaks.values()
    found.leaks = can_recycle and _MEMORY in leaks


def _held(pid: int) -> dict[str, float]:
    """Return what a process holds: open descriptors, threads, children; and MB, with theirs."""
    process = Path(f"/proc/{pid}")
    if not process.exists():
        return {}
    children = sum(len(one.read_text().split()) for one in process.glob("task/*/children"))
    return {
        "open descriptors": len([*(process / "fd").iterdir()]),
        "threads": len([*(process / "task").iterdir()]),
        "child processes": children,
        _MEMORY: resident_mb(pid),
    }


def _can_recycle(config: EnvConfig) -> bool:
    try:
        parse_configs([config.model_copy(update={"recycle": {"episodes": 1}})])
    except ConfigError:
        return False
    return True


def _leaks(samples: list[dict[str, float]], *, can_recycle: bool) -> dict[str, str]:
    """Say what has grown from the second episode to the last, by its name in the samples.

    The first episode loads and compiles.
    """
    found: dict[str, str] = {}
    if len(samples) < 4:
        return found
    count = len(samples) - 2
    for name, before in samples[1].items():
        more = samples[-1].get(name, before) - before
        if more >= max(count / 2, 2) if name != _MEMORY else more > _SLACK_MB:
            found[name] = (
                f"{more:.0f} more {name} after {count} episodes: close or drop in reset what the "
                "episode before has opened"
            )
            if name == _MEMORY and can_recycle:
                # Room for a hundred such episodes.
                limit = 100 * math.ceil((before + 100 * more / count) / 100)
                found[name] += (
                    f"; an episode leaves {more / count:.2g} MB: recycle: {{memory_mb: {limit}}} "
                    "has a worker with one env replaced in time"
                )
    return found


async def _renew(config: EnvConfig, found: _Finding) -> None:
    """Look whether an env's random numbers go on in the next worker."""
    played: list[list[bytes]] = []
    for recycle in ({}, {"episodes": 1}):
        one = config.model_copy(update={"recycle": recycle})
        async with rlightning_aio.build_env_group([one]) as group:
            batches = [(await group.reset(seed=seed))[0] for seed in (1, None, None)]
        played.append([_contents(batch) for batch in batches])
    if played[0] != played[1]:
        found.problems.append(
            "its random numbers begin again when its worker is replaced (recycle): keep generators "
            "in attributes of the env or its wrappers, or define save_state() and load_state()"
        )


async def _repeat(group: EnvGroup, steps: int, found: _Finding) -> None:
    """Play twice with the same seed and actions."""
    first, again = [
        [_contents(batch) async for batch in _results(group, steps, seed=1)] for _ in range(2)
    ]
    differs = next((k for k in range(steps + 1) if first[k] != again[k]), None)
    found.is_random = differs is not None
    if differs is not None:
        where = "the reset" if differs == 0 else f"step {differs}"
        found.problems.append(
            f"two episodes with the same seed and actions differ from {where} on: draw random "
            "numbers from a generator that reset(seed=…) seeds, such as gymnasium's np_random"
        )


def _contents(batch: BatchedData) -> bytes:
    parts: tuple[Any, ...] = batch.observation, batch.reward, batch.terminated, batch.truncated
    return pickle.dumps(parts)


async def _compare_spaces(group: EnvGroup, steps: int, found: _Finding) -> None:
    """Compare observations as the env returns them, before any is converted, with their space."""
    (meta,) = group.metas
    env, space = group[meta.env_id], cast("gym.Space[Any]", meta.observation_space)
    actions = cast("gym.Space[Any]", meta.action_space)
    rng = np.random.default_rng(0)
    sample = sampler_of(actions, rng)
    said = dict[str, str]()
    result = await env.call("reset", seed=2)
    for step in range(steps + 1):
        said |= _casts(space, result.observation)
        if (words := out_of_bounds(space, result.observation, "an observation")) is not None:
            said.setdefault("bounds", f"{words}: clip it, or declare a wider space")
        if step == steps or any(np.any(as_numpy(flag)) for flag in _ends(result)):
            break
        action = allowed_action(actions, index(sample(1), 0), result, rng)
        result = await env.call("step", PolicyResponse(meta.env_id, action=action))
    found.problems += said.values()


def _ends(result: Any) -> list[Any]:
    each: list[Any] = [result.last_terminated, result.last_truncated]
    return [flag for one in each for _, flag in walked(one)]


def _is_array(value: Any) -> bool:
    return isinstance(value, (np.ndarray, list, tuple))


def _casts(space: gym.Space[Any], observation: Any) -> dict[str, str]:
    """Say which parts of an observation have another dtype than their space."""
    said = dict[str, str]()
    for path, part in walked(tree_of(space)):
        value, name = held(observation, path), f"observation{in_brackets(path)}"
        kind = str(getattr(value, "dtype", type(value).__name__))
        # Numbers of Python have no dtype of their own.
        if not isinstance(part, _NUMBERS) or kind == str(part.dtype) or not _is_array(value):
            continue
        array: NDArray[Any] = np.asarray(value)
        with np.errstate(all="ignore"):
            converted = array.astype(part.dtype)
        same = np.array_equal(converted, array, equal_nan=array.dtype.kind == "f")
        loss = "no number changes, but it takes time" if same else "numbers are rounded"
        said[name] = (
            f"{name} is converted from {kind} to {part.dtype}: {loss}; return arrays of "
            f"{part.dtype}, or declare a space of another dtype"
        )
    return said


# -- output -----------------------------------------------------------------------------


def _lines(found: _Finding) -> Iterator[str]:
    each = "" if found.num_envs == 1 else f", {found.num_envs} sub-environments in each"
    head = f"{found.name}: {counted(found.num_workers, 'env')}{each} ({found.backend}"
    yield head + (f", {found.task})" if found.task else ")")
    if found.skipped is not None:
        yield f"  not started: {found.skipped}"
        return
    yield f"  observation  {found.observation_space}"
    yield f"  action       {found.action_space}"
    yield f"  step limit   {found.max_episode_steps or 'none'}"
    if not found.steps:
        yield "  reset; not stepped: only a policy can choose its actions"
        return
    yield f"  reset and stepped {found.steps} times"
    if found.is_played:
        took = f"; a step takes {duration(found.step_us)}" if found.step_us is not None else ""
        yield f"  {counted(found.episodes, 'episode')}{took}"
        yield from (f"  problem: {problem}" for problem in found.problems or ["none found"])
