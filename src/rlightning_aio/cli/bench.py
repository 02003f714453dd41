"""``rlightning-aio bench``: one config over placements, numbers of workers and batch rules."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
from pathlib import Path  # noqa: TC003 (Typer reads annotations)
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn

import rlightning_aio
from rlightning_aio.cli.measuring import (
    Contender,
    Limits,
    Rule,
    Setting,
    num_cores,
    opened,
    possible_settings,
    take_turns,
)
from rlightning_aio.cli.terminal import (
    INTERRUPTED,
    count,
    counted,
    duration,
    err,
    interruptible,
    named_columns,
    out,
    print_json,
)
from rlightning_aio.config import load_config
from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from rlightning_aio.config import EnvConfig

__all__ = ["Watch", "bench", "print_contenders"]


def bench(
    config: Annotated[Path, typer.Argument(help="YAML file with envs:", show_default=False)],
    overrides: Annotated[
        list[str] | None,
        typer.Argument(help="Dotted overrides, such as envs.0.num_workers=8", show_default=False),
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Turns of each contender.")] = 5,
    seconds: Annotated[float, typer.Option(min=0.001, help="Length of one measurement.")] = 0.5,
    steps: Annotated[
        int | None,
        typer.Option(min=1, help="End a measurement after so many.", show_default="no limit"),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Also draw the table (PNG, SVG or PDF; needs matplotlib).")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document in place of the table.")
    ] = False,
) -> None:
    """Measure how fast a config's envs go, and how to make them go faster.

    The envs live in this process, or in one worker, or in several; results are taken with a
    synchronous step of all envs, or asynchronously as soon as one, half or all of them are
    ready. All combinations take turns, and figures are medians over the rounds. Latency is
    the time from an action's sending to its result in hand. Actions are random.

    For example:

        rlightning-aio bench configs/halfcheetah.yaml
        rlightning-aio bench configs/cartpole.yaml envs.0.num_workers=256 --rounds 9
        rlightning-aio bench configs/hopper.yaml --plot hopper.png --json > hopper.json
    """
    configs = load_config(config, overrides or ())
    if plot is not None and importlib.util.find_spec("matplotlib") is None:
        raise ConfigError("--plot needs matplotlib: pip install matplotlib")
    settings = possible_settings(configs)
    contenders = [Contender(setting, rule) for setting in settings for rule in _rules(configs)]
    limits = Limits(steps or 2**62, seconds)
    try:
        with (
            Watch(settings, rounds * len(contenders)) as watch,
            interruptible(),
            contextlib.closing(_measure(settings, contenders, rounds, limits, watch)) as measuring,
        ):
            rlightning_aio.run(measuring)
    except KeyboardInterrupt:
        raise typer.Exit(INTERRUPTED) from None
    finally:
        if any(contender.rounds for contender in contenders):
            _report(str(config), contenders, plot, as_json=as_json)


def _rules(configs: Sequence[EnvConfig]) -> list[Rule]:
    num_envs = sum(config.num_workers for config in configs)
    half = max(1, num_envs // 2)
    named = {1: "async, first ready", half: "async, half", num_envs: "async, all"}
    return [Rule("step", None), *(Rule(words, least) for least, words in sorted(named.items()))]


async def _measure(
    settings: Sequence[Setting],
    contenders: Sequence[Contender],
    rounds: int,
    limits: Limits,
    watch: Watch,
) -> None:
    async with opened(settings) as stands:
        watch.say(f"measuring {counted(len(contenders), 'contender')}, {counted(rounds, 'round')}")
        await take_turns(stands, contenders, rounds, limits, watch.measured)


class Watch:
    """The live line on stderr; on anything but a terminal, plain lines."""

    def __init__(self, settings: Sequence[Setting], measurements: int) -> None:
        self._console = err()
        self._progress = Progress(
            SpinnerColumn(),
            BarColumn(bar_width=28),
            TextColumn("{task.description}"),
            console=self._console,
            auto_refresh=False,
            transient=True,
        )
        self._task = self._progress.add_task("", total=measurements)
        self._settings = settings

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._progress.start()
        self.say(f"starting {counted(len(self._settings), 'group')}")
        return self

    def __exit__(self, *exception: object) -> None:
        if self._console.is_terminal:
            self._progress.stop()

    def say(self, words: str, *, advance: int = 0) -> None:
        """What is being done now."""
        if self._console.is_terminal:
            self._progress.update(self._task, description=words, advance=advance)
            self._progress.refresh()
        elif not advance:
            self._console.print(words)

    def measured(self, contender: Contender) -> None:
        """One more measurement is done."""
        words = f"{contender.setting.words}, {contender.rule.words}"
        self.say(f"{words}: {count(contender.steps_per_second)} steps/s", advance=1)


def _report(
    config: str, contenders: Sequence[Contender], plot: Path | None, *, as_json: bool
) -> None:
    if as_json:
        print_json(
            {
                "config": config,
                "cores": num_cores(),
                "contenders": [contender.as_json() for contender in contenders],
            }
        )
    else:
        print_contenders(out(), config, contenders)
    if plot is not None:
        _draw(config, contenders, plot)


def print_contenders(console: Console, title: str, contenders: Sequence[Contender]) -> None:
    """The table of what was measured, the fastest in bold."""
    fastest = max(contenders, key=lambda contender: contender.steps_per_second)
    table = named_columns(
        f"{title}: {counted(num_cores(), 'core')}, "
        f"medians of {counted(len(fastest.rounds), 'round')}",
        "envs in", "results", "steps/s", "slowest", "fastest", "latency p50", "p99",
    )  # fmt: skip
    table.columns[1].justify = "left"
    for contender in contenders:
        table.add_row(*_row(contender), style="bold" if contender is fastest else None)
    console.print(table)
    failures = {c.setting.words: c.failure for c in contenders if c.failure}
    for words, failure in failures.items():
        console.print(f"{words}: {failure}", markup=False)


def _row(contender: Contender) -> list[str]:
    names = [contender.setting.words, contender.rule.words]
    if not contender.rounds:
        return [*names, *["-"] * 5]
    rates = (contender.steps_per_second, *contender.spread)
    return [*names, *map(count, rates), *map(duration, contender.latency_us)]


def _draw(config: str, contenders: Sequence[Contender], path: Path) -> None:
    """Bars of steps per second, one group of bars for each setting."""
    # An extra that only this needs, without types that say anything.
    importlib.import_module("matplotlib").use("Agg")
    plt: Any = importlib.import_module("matplotlib.pyplot")
    rules = list(dict.fromkeys(contender.rule.words for contender in contenders))
    settings = list(dict.fromkeys(contender.setting.words for contender in contenders))
    figure, axes = plt.subplots(figsize=(8, 1.2 + 0.22 * len(contenders)), layout="constrained")
    height = 0.8 / len(rules)
    for index, rule in enumerate(rules):
        own = [contender for contender in contenders if contender.rule.words == rule]
        axes.barh(
            [settings.index(c.setting.words) + index * height for c in own],
            [c.steps_per_second for c in own],
            height,
            label=rule,
        )
    axes.set_yticks([k + 0.4 - height / 2 for k in range(len(settings))], settings)
    axes.invert_yaxis()
    axes.set(xlabel="env steps per second", title=f"{config}, {counted(num_cores(), 'core')}")
    figure.legend(loc="outside lower center", ncols=len(rules))
    figure.savefig(path, dpi=150)
    plt.close(figure)
