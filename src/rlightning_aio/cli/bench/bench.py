"""``rlightning-aio bench``: one config over placements, numbers of workers and batch rules."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self, TypeAlias

import typer

from rlightning_aio.cli.bench.apart import opened
from rlightning_aio.cli.bench.baselines import Baseline, baselines_of
from rlightning_aio.cli.bench.best import best_of, verdict, write_best
from rlightning_aio.cli.bench.contender_table import print_contenders
from rlightning_aio.cli.bench.measuring import Contender, Limits, Rule, take_turns
from rlightning_aio.cli.bench.plots import check_plot, draw_contenders
from rlightning_aio.cli.bench.settings import Setting, possible_settings, swept_settings
from rlightning_aio.cli.live_line import LiveLine, time_left
from rlightning_aio.cli.measurement import machine_facts
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
    out,
    print_json,
    run_interruptible,
)
from rlightning_aio.config import load_config
from rlightning_aio.errors import ConfigError, RLightningError
from rlightning_aio.registry import ENVS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.cli.bench.measuring import Stands
    from rlightning_aio.config import EnvConfig
    from rlightning_aio.registry import Backend

__all__ = ["Watch", "bench"]


@dataclass
class _Bench:
    """The options of a measurement; `waits` are values of `min_results`, None the usual rules."""

    settings: list[Setting]
    baselines: list[Baseline]
    rounds: int
    limits: Limits
    policy: str | None
    seed: int
    trace: Path | None
    waits: list[int] | None
    contenders: list[Contender] = field(default_factory=list[Contender])

    def __post_init__(self) -> None:
        if self.policy is not None:
            load_policy(self.policy)  # Only a check: nothing has been started yet.
        self.contenders = [
            Contender(setting, rule)
            for setting in self.settings
            for rule in _rules(setting.num_envs, self.waits)
        ]
        self.contenders += [Contender(baseline, Rule("step", None)) for baseline in self.baselines]


@dataclass(frozen=True)
class _Output:
    """The options for the figures. They are checked before anything is measured."""

    config: Path
    as_json: bool
    plot: Path | None
    best: Path | None

    def __post_init__(self) -> None:
        check_plot(self.plot)
        check_option_file("--best", self.best)

    def report(
        self, configs: Sequence[EnvConfig], contenders: Sequence[Contender], *, interrupted: bool
    ) -> None:
        """Print and draw the figures, and write the best setting."""
        best = best_of(contenders)
        if self.as_json:
            print_json(
                {
                    "config": str(self.config),
                    "interrupted": interrupted,
                    **machine_facts(backend.module for backend in _backends(configs)),
                    "contenders": [contender.as_json() for contender in contenders],
                    "best": None if best is None else best.as_json(),
                }
            )
        else:
            title = ("Interrupted: " if interrupted else "") + str(self.config)
            print_contenders(out(), title, contenders)
            if best is not None:
                out().print(verdict(best, contenders), soft_wrap=True, markup=False)
        if self.plot is not None:
            draw_contenders(str(self.config), contenders, self.plot)
        if self.best is not None and best is not None:
            write_best(self.best, self.config, best, interrupted=interrupted)


_Steps: TypeAlias = Annotated[
    int | None,
    typer.Option(min=1, help="End a measurement after this many steps.", show_default="no limit"),
]
_Seed: TypeAlias = Annotated[
    int, typer.Option(min=0, help="Seed of the first reset and random actions.")
]
_Sweep: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        metavar="FIELD=A,B,…",
        help="Measure these values of a field in place of the usual settings, or of min_results in "
        "place of the usual rules. With several of these options, all combinations.",
        show_default=False,
    ),
]
_Best: TypeAlias = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Write the config with the best setting (YAML).")
]
_Trace: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Step the fastest group once more and write a timeline of it for "
        "https://ui.perfetto.dev.",
    ),
]


def bench(
    config: Config,
    overrides: Overrides = None,
    sweep: _Sweep = None,
    rounds: Rounds = 5,
    seconds: MeasuringSeconds = 0.5,
    steps: _Steps = None,
    policy: PolicyName = None,
    seed: _Seed = 0,
    plot: PlotFile = None,
    best: _Best = None,
    trace: _Trace = None,
    as_json: AsJson = False,
) -> None:
    """Measure how fast a config's envs run, and how to make them run faster.

    The envs live in this process, in one worker process, in several, or in both. Results come from
    a synchronous step of all envs, or asynchronously as soon as one, half or all of them
    are ready. Simulations that can share an env (num_envs) are also tried that way. A plain
    loop and Gymnasium's vector envs are measured as well, if these can make the envs. All take
    turns, and figures are medians over the rounds. Latency is the time from sending an action
    to receiving its result. Actions are random, unless --policy names a policy. With --sweep,
    only the values that it gives are compared.

    For example:

        rlightning-aio bench configs/halfcheetah.yaml
        rlightning-aio bench configs/cartpole.yaml envs.0.num_workers=256 --rounds 9
        rlightning-aio bench configs/hopper.yaml --plot hopper.png --json > hopper.json
        rlightning-aio bench configs/hopper.yaml --best fastest.yaml
        rlightning-aio bench configs/hopper.yaml --sweep num_workers=8,16 --sweep min_results=1,4
    """
    check_seed(seed)
    configs = load_config(config, overrides or ())
    output = _Output(config, as_json, plot, best)
    check_option_file("--trace", trace)
    sweeps = _values(sweep or ())
    waits = sweeps.pop("min_results", None)
    order = _Bench(
        swept_settings(config, overrides or (), sweeps) if sweeps else possible_settings(configs),
        # A policy takes a group's batches, which baselines don't have.
        [] if policy or sweep else baselines_of(configs),
        rounds,
        Limits(steps or 2**62, seconds),
        policy,
        seed,
        trace,
        None if waits is None else _numbers(waits),
    )
    interrupted = False
    try:
        with Watch(len(order.settings), rounds * len(order.contenders)) as watch:
            run_interruptible(_measure(order, watch))
    except KeyboardInterrupt:
        interrupted = True
        raise
    finally:
        if any(contender.rounds for contender in order.contenders):
            output.report(configs, order.contenders, interrupted=interrupted)


def _backends(configs: Sequence[EnvConfig]) -> list[Backend]:
    found = [ENVS.described(config.backend) for config in configs]
    return [backend for backend in found if backend is not None]


def _values(sweep: Sequence[str]) -> dict[str, list[str]]:
    """Return the values of each field that is swept."""
    found: dict[str, list[str]] = {}
    for text in sweep:
        name, equals, values = text.partition("=")
        if not (name and equals and all(values.split(","))):
            raise ConfigError(f"--sweep {text}: should be FIELD=A,B,…, such as num_workers=1,2,4")
        found[name] = values.split(",")
    return found


def _numbers(values: Sequence[str]) -> list[int]:
    """Return the values of `min_results`."""
    for text in values:
        if not text.isascii() or not text.isdigit() or not int(text):
            raise ConfigError(f"--sweep min_results={text}: should be a number from 1 on")
    return sorted(map(int, values))


def _rules(num_envs: int, waits: Sequence[int] | None) -> list[Rule]:
    if waits is not None:
        return [Rule(f"min_results={least}", least) for least in waits]
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
    """What `bench` says while it measures.

    Args:
        groups: number of groups to start first.
        measurements: number of measurements that follow.
    """

    def __init__(self, groups: int, measurements: int) -> None:
        self._measurements = measurements
        self._done = 0
        self._began = time.monotonic()
        self._words = f"starting {counted(groups, 'group')}"
        self._line = LiveLine(self._parts, lambda _now: self._done / self._measurements)

    def __enter__(self) -> Self:
        self._line.__enter__()
        self.say(self._words)
        return self

    def __exit__(self, *exception: object) -> None:
        self._line.stop()

    def _parts(self, now: float) -> list[str]:
        left = (now - self._began) * (self._measurements / self._done - 1) if self._done else None
        return [self._words, *([] if left is None else [time_left(left)])]

    def say(self, words: str) -> None:
        """Show the present activity."""
        self._words, self._began = words, time.monotonic()
        self._line.announce(words)

    def measured(self, contender: Contender) -> None:
        """Count a finished measurement."""
        self._done += 1
        words = f"{contender.setting.words}, {contender.rule.words}"
        self._words = f"{words}: {count(contender.steps_per_second)} steps/s"
        self._line.show()
