"""``rlightning-aio bench``: one config over placements, numbers of workers and batch rules."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, TypeAlias

import typer
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

from rlightning_aio.cli.bench.apart import opened
from rlightning_aio.cli.bench.baselines import Baseline, baselines_of
from rlightning_aio.cli.bench.comparing import Comparison, check_name, check_save, compared, save
from rlightning_aio.cli.bench.contender_table import as_csv, as_markdown, print_contenders
from rlightning_aio.cli.bench.measuring import Contender, Limits, Rule, take_turns
from rlightning_aio.cli.bench.plots import check_plot, draw_contenders
from rlightning_aio.cli.bench.publishing import publish
from rlightning_aio.cli.bench.settings import Setting, possible_settings
from rlightning_aio.cli.bench.surroundings import surroundings
from rlightning_aio.cli.option_files import check_option_file
from rlightning_aio.cli.options import (
    AsJson,
    Config,
    MeasuringSeconds,
    Overrides,
    PlotFile,
    PolicyName,
    Rounds,
    check_seed,
)
from rlightning_aio.cli.policies.policies import load_policy
from rlightning_aio.cli.terminal import (
    count,
    counted,
    err,
    out,
    print_json,
    print_result,
    run_interruptible,
)
from rlightning_aio.config import load_config
from rlightning_aio.errors import RLightningError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.cli.bench.measuring import Stands
    from rlightning_aio.config import EnvConfig

__all__ = ["Watch", "bench"]

REGRESSION = 3
"""Exit code if a contender has become slower than in the saved figures."""


class Format(StrEnum):
    """The format of the table."""

    TABLE = "table"
    CSV = "csv"
    MARKDOWN = "markdown"


@dataclass
class _Bench:
    """The options of a measurement."""

    settings: list[Setting]
    baselines: list[Baseline]
    rounds: int
    limits: Limits
    policy: str | None
    seed: int
    trace: Path | None
    contenders: list[Contender] = field(default_factory=list[Contender])

    def __post_init__(self) -> None:
        if self.policy is not None:
            load_policy(self.policy)  # Only a check: nothing has been started yet.
        self.contenders = [
            Contender(setting, rule)
            for setting in self.settings
            for rule in _rules(setting.num_envs)
        ]
        self.contenders += [Contender(baseline, Rule("step", None)) for baseline in self.baselines]


@dataclass(frozen=True)
class _Output:
    """The options for the figures. They are checked before anything is measured."""

    config: Path
    overrides: Sequence[str]
    table_format: Format
    as_json: bool
    plot: Path | None
    save_as: str | None
    compare: str | None
    publish: Path | None

    def __post_init__(self) -> None:
        check_plot(self.plot)
        check_name(self.save_as, must_exist=False)
        check_name(self.compare, must_exist=True)
        check_save(self.save_as)
        check_option_file("--publish", self.publish)

    def report(
        self, configs: Sequence[EnvConfig], contenders: Sequence[Contender], *, interrupted: bool
    ) -> bool:
        """Print, draw and save the figures. Return True if one is worse than it was saved."""
        document = {
            "config": str(self.config),
            "interrupted": interrupted,
            **surroundings(configs),
            "contenders": [contender.as_json() for contender in contenders],
        }
        comparison = None if self.compare is None else compared(self.compare, document)
        self._print(document, contenders, comparison)
        if self.plot is not None:
            draw_contenders(str(self.config), contenders, self.plot)
        if self.publish is not None:
            publish(self.publish, self.config, self.overrides, document, contenders)
        if self.save_as is not None and not interrupted:
            save(self.save_as, document)
        return comparison is not None and bool(comparison.slower)

    def _print(
        self,
        document: dict[str, Any],
        contenders: Sequence[Contender],
        comparison: Comparison | None,
    ) -> None:
        if self.as_json:
            compared_figures = {} if comparison is None else {"comparison": comparison.as_json()}
            print_json(document | compared_figures)
            return
        if self.table_format is Format.CSV:
            print_result(as_csv(contenders))
        elif self.table_format is Format.MARKDOWN:
            print_result(as_markdown(contenders))
        else:
            title = ("Interrupted: " if document["interrupted"] else "") + document["config"]
            print_contenders(out(), title, contenders)
        if comparison is not None:
            comparison.print(out() if self.table_format is Format.TABLE else err())


_Steps: TypeAlias = Annotated[
    int | None,
    typer.Option(min=1, help="End a measurement after this many steps.", show_default="no limit"),
]
_Seed: TypeAlias = Annotated[
    int, typer.Option(min=0, help="Seed of the first reset and random actions.")
]
_Save: TypeAlias = Annotated[
    str | None,
    typer.Option("--save", metavar="NAME", help="Save the figures to compare with later."),
]
_Compare: TypeAlias = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Compare with saved figures; exit code 3 if slower."),
]
_Trace: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Step the fastest group once more and write a timeline of it for "
        "https://ui.perfetto.dev.",
    ),
]
_Publish: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE", help="Write a page (Markdown) with the figures, the machine and the config."
    ),
]
_Format: TypeAlias = Annotated[Format, typer.Option("--format", help="Table format.")]


def bench(
    config: Config,
    overrides: Overrides = None,
    rounds: Rounds = 5,
    seconds: MeasuringSeconds = 0.5,
    steps: _Steps = None,
    policy: PolicyName = None,
    seed: _Seed = 0,
    save_as: _Save = None,
    compare: _Compare = None,
    plot: PlotFile = None,
    table_format: _Format = Format.TABLE,
    trace: _Trace = None,
    publish: _Publish = None,
    as_json: AsJson = False,
) -> None:
    """Measure how fast a config's envs run, and how to make them run faster.

    The envs live in this process, in one worker process, in several, or in both. Results come from
    a synchronous step of all envs, or asynchronously as soon as one, half or all of them
    are ready. Simulations that can share an env (num_envs) are also tried that way. A plain
    loop and Gymnasium's vector envs are measured as well, if these can make the envs. All take
    turns, and figures are medians over the rounds. Latency is the time from sending an action
    to receiving its result. Actions are random, unless --policy names a policy.

    For example:

        rlightning-aio bench configs/halfcheetah.yaml
        rlightning-aio bench configs/cartpole.yaml envs.0.num_workers=256 --rounds 9
        rlightning-aio bench configs/hopper.yaml --plot hopper.png --json > hopper.json
        rlightning-aio bench configs/hopper.yaml --save before --publish hopper.md
        rlightning-aio bench configs/hopper.yaml --compare before
    """
    check_seed(seed)
    configs = load_config(config, overrides or ())
    files = (plot, save_as, compare, publish)
    output = _Output(config, overrides or (), table_format, as_json, *files)
    check_option_file("--trace", trace)
    order = _Bench(
        possible_settings(configs),
        # A policy takes a group's batches, which baselines don't have.
        [] if policy else baselines_of(configs),
        rounds,
        Limits(steps or 2**62, seconds),
        policy,
        seed,
        trace,
    )
    interrupted = slower = False
    try:
        with Watch(len(order.settings), rounds * len(order.contenders)) as watch:
            run_interruptible(_measure(order, watch))
    except KeyboardInterrupt:
        interrupted = True
        raise
    finally:
        if any(contender.rounds for contender in order.contenders):
            slower = output.report(configs, order.contenders, interrupted=interrupted)
    if slower:
        raise typer.Exit(REGRESSION)


def _rules(num_envs: int) -> list[Rule]:
    half = max(1, num_envs // 2)
    named = {1: "async, first ready", half: "async, half", num_envs: "async, all"}
    return [Rule("step", None), *(Rule(words, least) for least, words in sorted(named.items()))]


async def _measure(order: _Bench, watch: Watch) -> None:
    places = [*order.settings, *order.baselines]
    async with opened(places, order.policy, order.seed) as stands:
        watch.say(
            f"measuring {counted(len(order.contenders), 'contender')}, "
            f"{counted(order.rounds, 'round')}"
        )
        await take_turns(stands, order.contenders, order.rounds, order.limits, watch.measured)
        if order.trace is not None:
            await _trace_fastest(order, stands, order.trace)


async def _trace_fastest(order: _Bench, stands: Stands, path: Path) -> None:
    """Measure the fastest of the groups once more, with its timeline recorded."""
    for contender in sorted(order.contenders, key=lambda c: c.steps_per_second, reverse=True):
        stand = stands[contender.setting]
        if isinstance(contender.setting, Setting) and not isinstance(stand, RLightningError):
            await stand.measure(contender.rule, order.limits, path)
            return


class Watch:
    """The live line on stderr, or plain lines if it is no terminal.

    Args:
        groups: number of groups to start first.
        measurements: number of measurements that follow.
    """

    def __init__(self, groups: int, measurements: int) -> None:
        self._console = err()
        self._progress = Progress(
            SpinnerColumn(),
            BarColumn(bar_width=16),
            TimeRemainingColumn(compact=True),
            TextColumn("{task.description}"),
            console=self._console,
            auto_refresh=False,
            transient=True,
        )
        self._task = self._progress.add_task("", total=measurements)
        self._groups = groups

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._progress.start()
        self.say(f"starting {counted(self._groups, 'group')}")
        return self

    def __exit__(self, *exception: object) -> None:
        if self._console.is_terminal:
            self._progress.stop()

    def say(self, words: str, *, advance: int = 0) -> None:
        """Show the present activity."""
        if self._console.is_terminal:
            self._progress.update(self._task, description=words, advance=advance)
            self._progress.refresh()
        elif not advance:
            self._console.print(words)

    def measured(self, contender: Contender) -> None:
        """Count a finished measurement."""
        words = f"{contender.setting.words}, {contender.rule.words}"
        self.say(f"{words}: {count(contender.steps_per_second)} steps/s", advance=1)
