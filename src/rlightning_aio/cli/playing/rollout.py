"""``rlightning-aio rollout`` collects steps asynchronously and prints statistics."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path  # noqa: TC003 (Typer reads annotations)
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias

import typer

import rlightning_aio
from rlightning_aio._core.group.api.facade import default_min_results, ensure_auto_reset
from rlightning_aio.cli.bench.plots import check_plot, draw_rollout
from rlightning_aio.cli.option_files import check_option_file
from rlightning_aio.cli.options import (
    AsJson,
    Config,
    Overrides,
    PlotFile,
    PolicyName,
    TraceFile,
    check_seed,
)
from rlightning_aio.cli.playing.live import Display
from rlightning_aio.cli.policies.collecting import (
    Roster,
    respond_to_all,
    responder,
    traced,
)
from rlightning_aio.cli.policies.policies import Policy, load_policy
from rlightning_aio.cli.rollout_statistics import EntryFigures, RolloutStatistics
from rlightning_aio.cli.terminal import (
    count,
    counted,
    duration,
    named_columns,
    notes_on_returns,
    number,
    out,
    print_json,
    print_table,
    run_interruptible,
)
from rlightning_aio.config import EnvConfig, load_config
from rlightning_aio.errors import EnvFault, RLightningError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Sequence

    from rlightning_aio._core.group.api.aio import EnvGroup


__all__ = ["rollout"]

_ENDLESS = 2**62
_STEPS = 10_000
"""Default number of steps."""


@dataclass(frozen=True)
class _Order:
    """The options of a rollout."""

    steps: int | None
    seconds: float | None
    min_results: int | None
    seed: int | None
    policy: Policy | None
    trace: Path | None

    def left(self, statistics: RolloutStatistics) -> tuple[int, float | None] | None:
        """Return the steps and seconds that are left, or None at the end."""
        steps = _ENDLESS if self.steps is None else self.steps - statistics.steps
        seconds = self.seconds
        if seconds is not None:
            seconds -= statistics.elapsed(time.monotonic())
        return None if steps <= 0 or (seconds is not None and seconds <= 0) else (steps, seconds)


_Steps: TypeAlias = Annotated[
    int | None,
    typer.Option(min=1, help="Env steps to collect.", show_default="10000, or for --seconds"),
]
_Seconds: TypeAlias = Annotated[
    float | None,
    typer.Option(min=0.001, help="Seconds to collect for.", show_default="no limit"),
]
_Seed: TypeAlias = Annotated[
    int | None, typer.Option(min=0, help="Seed of the first reset and random actions.")
]
_MinResults: TypeAlias = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Results to wait for in each collect.",
        show_default="half of the envs",
    ),
]


def rollout(
    config: Config,
    overrides: Overrides = None,
    steps: _Steps = None,
    seconds: _Seconds = None,
    policy: PolicyName = None,
    seed: _Seed = None,
    min_results: _MinResults = None,
    plot: PlotFile = None,
    trace: TraceFile = None,
    as_json: AsJson = False,
) -> None:
    """Collect steps from a config's envs and print a table of the results.

    Actions are sampled at random from the envs' action spaces, or come from the callable that
    --policy names. It gets a BatchedData (one for each entry, if their spaces differ) and
    returns actions, one row for each result, or a dict of columns with 'action', or a batch made
    with its respond() method.
    Ctrl-C ends the collection early and prints the table so far.

    For example:

        rlightning-aio rollout configs/halfcheetah.yaml --steps 100000
        rlightning-aio rollout configs/cartpole.yaml envs.0.num_workers=128 --seed 0
        rlightning-aio rollout configs/hopper.yaml --policy my_policies:greedy
        rlightning-aio rollout configs/multi_task.yaml --json > rollout.json
        rlightning-aio rollout configs/halfcheetah.yaml --trace run.json
    """
    check_seed(seed)
    configs = load_config(config, overrides or ())
    check_plot(plot)
    limit = _STEPS if steps is None and seconds is None else steps
    chosen = load_policy(policy) if policy else None
    order = _Order(limit, seconds, min_results, seed, chosen, trace)
    check_option_file("--trace", trace)
    statistics = RolloutStatistics(configs, keep_course=plot is not None)
    group = rlightning_aio.build_env_group(list(configs), mixed_actions=True)
    interrupted = completed = False
    try:
        with Display(group, statistics, order.steps, seconds) as display:
            run_interruptible(_collect(group, configs, order, statistics, display))
        completed = True
    except KeyboardInterrupt:
        interrupted = True
        raise
    finally:
        # After an error, too: the statistics until then may be useful.
        if completed or interrupted or statistics.steps:
            _report(config, group, statistics, plot, interrupted=interrupted, as_json=as_json)
    if not statistics.steps:
        raise RLightningError("no step has ended in that time; allow more with --seconds")


async def _collect(
    group: EnvGroup,
    configs: Sequence[EnvConfig],
    order: _Order,
    statistics: RolloutStatistics,
    display: Display,
) -> None:
    async with (
        display.line.ticking(),
        group,
        traced(group, order.trace),
        _workers_noted(group, statistics),
    ):
        roster = Roster(group)
        for server in roster.servers:
            display.line.say(f"{server.env_id} listens at {server.address}")
        display.resetting()
        batch, _ = await group.reset(seed=order.seed)
        respond = responder(group, roster, order.policy, order.seed)
        sub_envs = max(config.num_envs for config in configs)
        display.ready()
        statistics.begin(roster)
        wanted = order.min_results or default_min_results(group)
        with ensure_auto_reset(group):
            await respond_to_all(group, respond, batch)
            while (left := order.left(statistics)) is not None:
                most, seconds = -(-left[0] // sub_envs), left[1]
                try:
                    batch, _ = await group.collect_async(
                        min_results=min(wanted, most),
                        max_results=most,
                        deadline=seconds,
                    )
                except EnvFault:
                    raise  # Among them those of envs that raised `TimeoutError`.
                except TimeoutError:
                    statistics.end(time.monotonic())  # The time limit has passed while waiting.
                    break
                statistics.add(batch)
                await respond_to_all(group, respond, batch)
                if display.line.due():
                    display.line.show()
                    # If results are always ready, nothing else would let Ctrl-C take effect.
                    await asyncio.sleep(0)


@contextlib.asynccontextmanager
async def _workers_noted(group: EnvGroup, statistics: RolloutStatistics) -> AsyncGenerator[None]:
    """Record the workers' restarts at the end, while the group can say them."""
    try:
        yield
    finally:
        statistics.note_workers(group.get_workers())


def _report(
    config: Path,
    group: EnvGroup,
    statistics: RolloutStatistics,
    plot: Path | None,
    *,
    interrupted: bool,
    as_json: bool,
) -> None:
    env_stats = group.get_env_stats()
    entries = statistics.by_entry(env_stats)
    notes = notes_on_returns(
        env_id
        for env_id, own in env_stats.items()
        if own["episodes"] and not math.isfinite(own["mean_return"])
    )
    notes += _notes_on_losses(entries)
    if any(entry.episodes for entry in entries):
        notes.append(_BIAS)
    stats = group.get_stats()
    if as_json:
        print_json(
            {
                "config": str(config),
                "interrupted": interrupted,
                "seconds": statistics.seconds,
                "steps": statistics.steps,
                "steps_per_second": statistics.steps_per_second,
                "notes": notes,
                "entries": [asdict(entry) for entry in entries],
                "batch_size": stats["batch_size"],
                "latency_us": stats["latency_us"],
            }
        )
    else:
        title = (
            f"{'Interrupted after ' if interrupted else ''}{count(statistics.steps)} steps in "
            f"{statistics.seconds:.1f} s: {count(statistics.steps_per_second)} steps/s"
        )
        _print_table(title, entries, stats["latency_us"])
        for note in notes:
            out().print(note, markup=False)
    if plot is not None:
        draw_rollout(str(config), statistics.courses(), plot)


def _notes_on_losses(entries: Sequence[EntryFigures]) -> list[str]:
    """Return a note on each entry whose workers or clients were lost."""
    return [
        f"entry {entry.name!r}: {counted(entry.restarts, 'restart')}, "
        f"{counted(entry.lost_steps, 'lost step')}"
        + "".join(f"; {cause}: {counted(n, 'result')}" for cause, n in entry.losses.items())
        for entry in entries
        if entry.restarts or entry.losses
    ]


_BIAS: Final = (
    "Mean return and length are those of the episodes that ended first, which favours short ones; "
    "to measure a policy, use rlightning-aio eval."
)
_EXPENDABLE = ("\np99", "envs", "mean\nlength", "steps", "episodes", "step\np50")


def _print_table(
    title: str, entries: Sequence[EntryFigures], latency: dict[str, dict[str, float]]
) -> None:
    table = named_columns(
        title,
        "entry", "envs", "steps", "steps/s", "episodes", "mean\nreturn", "mean\nlength",
        "step\np50", "\np99",
    )  # fmt: skip
    for entry in entries:
        step = entry.step_us or {}
        table.add_row(
            entry.name,
            count(entry.envs),
            count(entry.steps),
            count(entry.steps_per_second),
            count(entry.episodes),
            number(entry.mean_return),
            number(entry.mean_length),
            duration(step.get("p50")),
            duration(step.get("p99")),
        )
    console = out()
    print_table(console, table, _EXPENDABLE)
    if latency:
        shares = (("step", "in the env"), ("wait", "before it"), ("transfer", "after it"))
        console.print(
            "parts of a step, median and p99: "
            + ", ".join(
                f"{duration(latency[kind]['p50'])} ({duration(latency[kind]['p99'])}) {words}"
                for kind, words in shares
            )
        )
