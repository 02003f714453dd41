"""``rlightning-aio rollout``: collect steps asynchronously, and say how it went."""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import asdict, dataclass
from pathlib import Path  # noqa: TC003 (Typer reads annotations)
from typing import TYPE_CHECKING, Annotated, Final, Self

import typer
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn

import rlightning_aio
from rlightning_aio.cli.collecting import (
    Roster,
    check_trace,
    resetting,
    respond_to_all,
    responder,
    traced,
)
from rlightning_aio.cli.policies import Policy, load_policy
from rlightning_aio.cli.rollout_statistics import EntryFigures, RolloutStatistics
from rlightning_aio.cli.terminal import (
    INTERRUPTED,
    count,
    counted,
    duration,
    err,
    interruptible,
    named_columns,
    number,
    out,
    print_json,
)
from rlightning_aio.config import EnvConfig, load_config

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.group.aio import EnvGroup

__all__ = ["rollout"]

_REFRESH_SECONDS: Final = 0.2


@dataclass(frozen=True)
class _Order:
    """What to collect, and how."""

    steps: int
    min_results: int
    seed: int | None
    policy: Policy | None
    trace: Path | None


def rollout(
    config: Annotated[Path, typer.Argument(help="YAML file with envs:", show_default=False)],
    overrides: Annotated[
        list[str] | None,
        typer.Argument(help="Dotted overrides, such as envs.0.num_workers=8", show_default=False),
    ] = None,
    steps: Annotated[int, typer.Option(min=1, help="Env steps to collect.")] = 10_000,
    policy: Annotated[
        str | None,
        typer.Option(metavar="MODULE:CALLABLE", help="Takes a batch, returns actions."),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Of the envs' first reset and the random actions.")
    ] = None,
    min_results: Annotated[
        int | None,
        typer.Option(
            min=1, help="Results to wait for in each collect.", show_default="half of the envs"
        ),
    ] = None,
    trace: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a timeline for https://ui.perfetto.dev."),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document in place of the table.")
    ] = False,
) -> None:
    """Collect steps from a config's envs and print a table of what came.

    Actions are sampled at random from the envs' action spaces, or made by the callable that
    --policy names. It gets a BatchedData (one for each entry, where their spaces differ) and
    returns actions, one row for each result, or a batch made with its respond() method.
    Ctrl-C ends the collecting early and prints the table of what there is.

    For example:

        rlightning-aio rollout configs/halfcheetah.yaml --steps 100000
        rlightning-aio rollout configs/cartpole.yaml envs.0.num_workers=128 --seed 0
        rlightning-aio rollout configs/hopper.yaml --policy my_policies:greedy
        rlightning-aio rollout configs/multi_task.yaml --json > rollout.json
        rlightning-aio rollout configs/halfcheetah.yaml --trace run.json
    """
    configs = load_config(config, overrides or ())
    num_envs = sum(entry.num_workers for entry in configs)
    order = _Order(
        steps=steps,
        min_results=min_results or max(1, num_envs // 2),
        seed=seed,
        policy=load_policy(policy) if policy else None,
        trace=trace,
    )
    check_trace(trace)
    statistics = RolloutStatistics(configs)
    group = rlightning_aio.build_env_group(configs, mixed_actions=True)
    interrupted = False
    try:
        with (
            _Display(group, statistics, steps) as display,
            interruptible(),
            contextlib.closing(_collect(group, configs, order, statistics, display)) as collecting,
        ):
            rlightning_aio.run(collecting)
    except KeyboardInterrupt:
        interrupted = True
        raise typer.Exit(INTERRUPTED) from None
    finally:
        # Also after an error: what was collected until then is worth knowing.
        if interrupted or statistics.steps:
            _report(config, group, statistics, interrupted=interrupted, as_json=as_json)


async def _collect(
    group: EnvGroup,
    configs: Sequence[EnvConfig],
    order: _Order,
    statistics: RolloutStatistics,
    display: _Display,
) -> None:
    async with group, traced(group, order.trace):
        roster = Roster(group, await group.init())
        for server in roster.servers:
            display.say(f"{server.env_id} listens at {server.address}")
        batch, _ = await group.reset(seed=order.seed)
        respond = responder(group, roster, order.policy, order.seed)
        sub_envs = max(config.num_envs for config in configs)
        display.ready()
        statistics.begin(roster)
        with resetting(group, configs):
            await respond_to_all(group, respond, batch)
            while (left := order.steps - statistics.steps) > 0:
                most = -(-left // sub_envs)
                batch, _ = await group.collect_async(
                    min_results=min(order.min_results, most), max_results=most
                )
                statistics.add(batch)
                await respond_to_all(group, respond, batch)
                if display.due():
                    display.show()
                    # Where results never keep us waiting, nothing else would let Ctrl-C in.
                    await asyncio.sleep(0)


class _Display:
    """The live line on stderr; on anything but a terminal, plain lines at the start."""

    def __init__(self, group: EnvGroup, statistics: RolloutStatistics, steps: int) -> None:
        self._group = group
        self._statistics = statistics
        self._steps = steps
        self._console = err()
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=16),
            TextColumn("{task.fields[figures]}"),
            console=self._console,
            auto_refresh=False,
            transient=True,
        )
        self._starting = f"starting {counted(len(group), 'env')}"
        self._task: TaskID = self._progress.add_task(self._starting, total=steps, figures="")
        self._next_at = 0.0
        self._last = (0.0, 0)

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._progress.start()
            self._progress.refresh()
        else:
            self._console.print(self._starting)
        return self

    def __exit__(self, *exception: object) -> None:
        if self._console.is_terminal:
            self._progress.stop()

    def ready(self) -> None:
        """All envs have had their first reset."""
        if self._console.is_terminal:
            self._progress.update(self._task, description="")
        else:
            self._console.print(f"collecting {counted(self._steps, 'step')}")

    def say(self, words: str) -> None:
        """Add a line that stays."""
        self._console.print(words, soft_wrap=True)

    def due(self) -> bool:
        """Whether it is time to show something new."""
        return time.monotonic() >= self._next_at

    def show(self) -> None:
        """Draw the figures as they are now."""
        now = time.monotonic()
        self._next_at = now + _REFRESH_SECONDS
        if not self._console.is_terminal:
            return
        then, steps = self._last
        self._last = now, self._statistics.steps
        rate = (self._statistics.steps - steps) / (now - then)
        entries = self._statistics.by_entry(self._group.get_env_stats())
        self._progress.update(
            self._task, completed=self._statistics.steps, figures=_figures(entries, rate)
        )
        self._progress.refresh()


def _figures(entries: Sequence[EntryFigures], rate: float) -> str:
    steps = sum(entry.steps for entry in entries)
    episodes = sum(entry.episodes for entry in entries)
    total = sum((entry.mean_return or 0.0) * entry.episodes for entry in entries)
    mean = number(total / episodes if episodes else None)
    return f"{count(steps)} steps  {count(rate)} steps/s  {count(episodes)} episodes  return {mean}"


def _report(
    config: Path,
    group: EnvGroup,
    statistics: RolloutStatistics,
    *,
    interrupted: bool,
    as_json: bool,
) -> None:
    entries = statistics.by_entry(group.get_env_stats())
    stats = group.get_stats()
    if as_json:
        print_json(
            {
                "config": str(config),
                "interrupted": interrupted,
                "seconds": statistics.seconds,
                "steps": statistics.steps,
                "steps_per_second": statistics.steps_per_second,
                "entries": [asdict(entry) for entry in entries],
                "batch_size": stats["batch_size"],
                "latency_us": stats["latency_us"],
            }
        )
        return
    title = (
        f"{'Interrupted after ' if interrupted else ''}{count(statistics.steps)} steps in "
        f"{statistics.seconds:.1f} s: {count(statistics.steps_per_second)} steps/s"
    )
    _print_table(title, entries, stats["latency_us"])


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
    console.print(table)
    if latency:
        shares = (("step", "in the env"), ("wait", "before it"), ("transfer", "after it"))
        console.print(
            "a step's way, median and p99: "
            + ", ".join(
                f"{duration(latency[kind]['p50'])} ({duration(latency[kind]['p99'])}) {words}"
                for kind, words in shares
            )
        )
