"""``rlightning-aio rollout`` collects steps asynchronously and prints the group's numbers.

Rule: the numbers are those of `EnvGroup.metrics`, under the same names.
"""

from __future__ import annotations

import contextlib
import math
import time
from dataclasses import dataclass

# Typer reads annotations.
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeAlias

import typer

import rlightning_aio
from rlightning_aio._core.group.api.facade import default_min_results, ensure_auto_reset
from rlightning_aio.cli.options import AsJson, Config, Overrides, PolicyName, Seed
from rlightning_aio.cli.policies import (
    Responder,
    load_policy,
    respond_to_all,
    servers_announced,
    steps_in,
)
from rlightning_aio.cli.terminal import (
    Progress,
    connections_logged,
    count,
    counted,
    named_columns,
    print_json,
    print_lines,
    print_table,
    run_interruptible,
)
from rlightning_aio.config import load_config

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.config import EnvConfig

_BIAS: Final = (
    "Mean return and length are those of the episodes that ended first, which favours short ones; "
    "to measure a policy, use rlightning-aio eval."
)

_Steps: TypeAlias = Annotated[int, typer.Option(min=1, help="Env steps to collect.")]

_MinResults: TypeAlias = Annotated[
    int | None,
    typer.Option(
        min=1, help="Results to wait for in each collect.", show_default="half of the envs"
    ),
]

_Trace: TypeAlias = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Write a timeline for https://ui.perfetto.dev."),
]


@dataclass
class _Rollout:
    """A rollout: what was asked for, and what was done."""

    configs: Sequence[EnvConfig]
    most_steps: int
    min_results: int | None
    seed: int | None
    steps: int = 0
    began: float = 0.0
    ended: float = 0.0

    @property
    def seconds(self) -> float:
        """From the first step sent to the last result."""
        return self.ended - self.began

    @property
    def rate(self) -> float:
        """Steps per second."""
        return self.steps / self.seconds if self.seconds else 0.0


def rollout(
    config: Config,
    overrides: Overrides = None,
    steps: _Steps = 10_000,
    policy: PolicyName = None,
    seed: Seed = None,
    min_results: _MinResults = None,
    trace: _Trace = None,
    as_json: AsJson = False,
) -> None:
    """Collect steps from a config's envs and print the numbers of the group.

    Actions are sampled at random from the envs' action spaces, or come from the policy that
    --policy names. It gets a BatchedData and returns actions, one row for each result, or a dict
    of columns with 'action', or a batch made with its respond() method.
    Ctrl-C ends the collection early and prints the numbers so far.

    For example:

        rlightning-aio rollout configs/halfcheetah.yaml --steps 100000
        rlightning-aio rollout configs/cartpole.yaml envs.0.num_workers=128 --seed 0
        rlightning-aio rollout configs/hopper.yaml --policy my_policies:greedy
        rlightning-aio rollout configs/multi_task.yaml --json > rollout.json
        rlightning-aio rollout configs/halfcheetah.yaml --trace run.json
    """
    configs = load_config(config, overrides or ())
    done = _Rollout(configs, steps, min_results, seed)
    chosen = load_policy(policy) if policy else None
    group = rlightning_aio.build_env_group(list(configs), mixed_actions=True)
    interrupted = False
    try:
        with Progress() as progress, connections_logged():
            run_interruptible(_collect(group, done, chosen, trace, progress))
    except KeyboardInterrupt:
        interrupted = True
        raise
    finally:
        # After an error, too: the numbers until then may be useful.
        if interrupted or done.steps:
            _report(str(config), group, done, interrupted=interrupted, as_json=as_json)


async def _collect(
    group: EnvGroup, done: _Rollout, policy: Any, trace: Path | None, progress: Progress
) -> None:
    progress.begin(f"starting {counted(len(group), 'env')}")
    timeline = contextlib.nullcontext() if trace is None else group.trace(trace)
    async with group:
        with timeline:
            servers_announced(group, progress)
            progress.begin("first reset")
            batch, _ = await group.reset(seed=done.seed)
            respond = Responder(group, policy, done.seed)
            progress.begin(f"collecting {counted(done.most_steps, 'step')}", done.most_steps)
            done.began = done.ended = time.monotonic()
            with ensure_auto_reset(group):
                await respond_to_all(group, respond, batch)
                await _go_on(group, done, respond, progress)


async def _go_on(group: EnvGroup, done: _Rollout, respond: Responder, progress: Progress) -> None:
    sub_envs = max(config.num_envs for config in done.configs)
    wanted = done.min_results or default_min_results(group)

    def words() -> str:
        return f"{count(done.steps)} steps, {count(done.rate)} steps/s"

    while (left := done.most_steps - done.steps) > 0:
        most = -(-left // sub_envs)
        batch, _ = await group.collect_async(min_results=min(wanted, most), max_results=most)
        done.steps, done.ended = done.steps + steps_in(batch), time.monotonic()
        await respond_to_all(group, respond, batch)
        await progress.show(done.steps, words)


def _report(
    config: str, group: EnvGroup, done: _Rollout, *, interrupted: bool, as_json: bool
) -> None:
    numbers = group.metrics(by_entry=True)
    if as_json:
        print_json(
            {
                "config": config,
                "interrupted": interrupted,
                "seconds": done.seconds,
                "steps": done.steps,
                "steps_per_second": done.rate,
                "metrics": numbers,
            }
        )
        return
    title = (
        f"{'Interrupted after ' if interrupted else ''}{count(done.steps)} steps in "
        f"{done.seconds:.1f} s: {count(done.rate)} steps/s"
    )
    print_lines([title])  # A narrow table would fold it.
    entries = [config.name for config in done.configs]
    _print_numbers(numbers, entries if len(entries) > 1 else [])


def _print_numbers(numbers: Mapping[str, float], entries: Sequence[str]) -> None:
    """Print what is not 0 of the whole group, and of each of several entries."""
    table = named_columns("", "", "all", *entries)
    table.show_header = bool(entries)
    prefixes = ["envs/", *(f"envs/{entry}/" for entry in entries)]
    for short in (name.removeprefix("envs/") for name in numbers if name.count("/") == 1):
        own = [numbers.get(prefix + short) for prefix in prefixes]
        if any(own):  # Most counters of failures are 0.
            table.add_row(short, *map(_text, own))
    episodes = [numbers[f"{prefix}episodes"] for prefix in prefixes]
    for what in ("return", "length") if episodes[0] else ():
        sums = [numbers[f"{prefix}episode_{what}s"] for prefix in prefixes]
        means = [total / n if n else None for total, n in zip(sums, episodes, strict=True)]
        table.add_row(f"mean_{what}", *map(_text, means))
    print_table(table)
    if episodes[0]:
        print_lines([_BIAS])


def _text(value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return "-"
    return count(value) if float(value).is_integer() else f"{value:,.6g}"
