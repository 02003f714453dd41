"""``rlightning-aio bench``: one config over placements, numbers of workers and batch rules.

Rule: all is measured in one child process, which an env may end; then the command says so. One
place is open at a time: its rules take turns (A B C A B C …), and figures are medians over the
rounds.
"""

from __future__ import annotations

import contextlib
import itertools
import mmap
import os
import signal
import sys
import traceback
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter

# Typer reads annotations.
from pathlib import Path  # noqa: TC003
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from rlightning_aio._core.hosts.process.fork_server import die_with_parent
from rlightning_aio._core.hosts.processes import ending
from rlightning_aio.cli.baselines import Baseline, baselines_of
from rlightning_aio.cli.measurement import in_turns, machine_facts
from rlightning_aio.cli.measuring import Contender, Rule
from rlightning_aio.cli.options import AsJson, Config, Overrides, PlotFile, Seed
from rlightning_aio.cli.plots import check_plot, draw_contenders
from rlightning_aio.cli.settings import Setting, possible_settings, swept_settings
from rlightning_aio.cli.terminal import (
    INTERRUPTED,
    Progress,
    count,
    counted,
    duration,
    exit_code_of,
    handling,
    in_words,
    named_columns,
    print_json,
    print_lines,
    print_table,
    run_interruptible,
)
from rlightning_aio.config import load_config
from rlightning_aio.errors import ConfigError, RLightningError
from rlightning_aio.registry import ENVS
from rlightning_aio.sharing import num_cores

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rlightning_aio.config import EnvConfig

_NOTE: Final = 1024
"""Bytes of the text that says what the child does."""


@dataclass
class _Order:
    """The options, and what was measured."""

    path: Path
    overrides: Sequence[str]
    sweep: Sequence[str]
    rounds: int
    seconds: float
    seed: int | None
    plot: Path | None
    as_json: bool
    contenders: list[Contender] = field(default_factory=list[Contender])


def bench(
    config: Config,
    overrides: Overrides = None,
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FIELD=A,B,…",
            help="Measure these values of a field in place of the usual settings, or of "
            "min_results in place of the usual rules. With several of these options, all "
            "combinations.",
            show_default=False,
        ),
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Number of turns for each contender.")] = 5,
    seconds: Annotated[
        float, typer.Option(min=0.001, help="Length of one measurement, in seconds.")
    ] = 0.5,
    seed: Seed = 0,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Measure how fast a config's envs run, and how to make them run faster.

    The envs live in this process, in one worker process, in several, or in both. Results come from
    a synchronous step of all envs, or asynchronously as soon as one, half or all of them
    are ready. Simulations that can share an env (num_envs) are also tried that way. A plain
    loop and Gymnasium's vector envs are measured as well, if these can make the envs. Figures are
    medians over the rounds. Latency is the time from sending an action to receiving its result.
    Actions are random. With --sweep, only the values that it gives are compared.

    For example:

        rlightning-aio bench configs/halfcheetah.yaml
        rlightning-aio bench configs/cartpole.yaml envs.0.num_workers=256 --rounds 9
        rlightning-aio bench configs/hopper.yaml --plot hopper.png --json > hopper.json
        rlightning-aio bench configs/hopper.yaml --sweep num_workers=8,16 --sweep min_results=1,4
    """
    check_plot(plot)
    order = _Order(
        config, overrides or (), sweep or (), rounds, seconds, seed, plot, as_json=as_json
    )
    _run_in_child(partial(_bench, order))


# -- the child -------------------------------------------------------------------------------


def _run_in_child(work: Callable[[Callable[[str], None]], None]) -> None:
    """Run `work` in a process of its own, and end as it does.

    Args:
        work: called with a function that notes what is being done.

    Raises:
        typer.Exit: with the exit code of the child.
        RLightningError: it has ended without a result.
    """
    memory = mmap.mmap(-1, _NOTE)

    def note(words: str) -> None:
        memory[:] = words.encode()[:_NOTE].ljust(_NOTE, b"\0")

    note("loading the config")
    sys.stderr.flush()
    child = os.fork()
    if not child:
        _end_after(partial(work, note), lambda: note(""))
    # An event loop takes the first for a wish; an env that keeps it needs another one, or the end.
    signals = itertools.chain([signal.SIGINT] * 3, itertools.repeat(signal.SIGKILL))

    def pass_on(number: int, frame: Any) -> None:
        del number, frame
        os.kill(child, next(signals))

    with handling(pass_on):
        _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    doing = memory[:].rstrip(b"\0").decode(errors="replace")
    if doing and code != INTERRUPTED:
        raise RLightningError(
            f"{doing}: the process that stepped the envs {ending(code)}, so there is no table"
        )
    if code:
        raise typer.Exit(code)


def _end_after(work: Callable[[], None], tell_end: Callable[[], None]) -> None:
    """Run `work` and end this process, a child that Ctrl-C of the terminal doesn't reach."""
    code = 1
    try:
        os.setsid()
        die_with_parent()
        with contextlib.suppress(BrokenPipeError):  # Who reads the table has gone.
            code = exit_code_of(work)
        tell_end()
    except BaseException:  # noqa: BLE001  # Also what an env raises to end its process.
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def _bench(order: _Order, note: Callable[[str], None]) -> None:
    configs = load_config(order.path, order.overrides)
    order.contenders = _contenders(order, configs)
    interrupted = True
    try:
        with Progress() as progress:
            run_interruptible(_measure(order, note, progress))
        interrupted = False
    finally:
        if any(contender.rounds for contender in order.contenders):
            _report(order, configs, interrupted=interrupted)


def _contenders(order: _Order, configs: Sequence[EnvConfig]) -> list[Contender]:
    sweeps: dict[str, list[str]] = {}
    for text in order.sweep:
        name, equals, values = text.partition("=")
        if not (name and equals and all(values.split(","))):
            raise ConfigError(f"--sweep {text}: should be FIELD=A,B,…, such as num_workers=1,2,4")
        sweeps.setdefault(name, []).extend(values.split(","))
    waits = sweeps.pop("min_results", None)
    settings = (
        swept_settings(order.path, order.overrides, sweeps)
        if sweeps
        else possible_settings(configs)
    )
    contenders = [
        Contender(setting, rule)
        for setting in settings
        for rule in (_usual_rules(setting.num_envs) if waits is None else _rules(waits))
    ]
    if not order.sweep:
        contenders += [Contender(one, Rule("step", None)) for one in baselines_of(configs)]
    return contenders


def _rules(values: Sequence[str]) -> list[Rule]:
    for text in values:
        if not text.isascii() or not text.isdigit() or not int(text):
            raise ConfigError(f"--sweep min_results={text}: should be a number from 1 on")
    return [Rule(f"min_results={least}", least) for least in sorted(map(int, values))]


def _usual_rules(num_envs: int) -> list[Rule]:
    half = max(1, num_envs // 2)
    named = {1: "async, first ready", half: "async, half", num_envs: "async, all"}
    return [Rule("step", None), *(Rule(words, least) for least, words in sorted(named.items()))]


async def _measure(order: _Order, note: Callable[[str], None], progress: Progress) -> None:
    contenders, done = order.contenders, 0
    words = f"measuring {counted(len(contenders), 'contender')}, {counted(order.rounds, 'round')}"
    progress.begin(words, len(contenders) * order.rounds)
    error: Exception | None = None
    for place, group in itertools.groupby(contenders, attrgetter("place")):
        own = list(group)
        note(f"starting {place.words}")
        try:
            async with place.opened(order.seed) as measure:
                for _, contender in in_turns(own, order.rounds):
                    note(contender.words)
                    contender.rounds.append(await measure(contender.rule, order.seconds))
                    done += 1
                    rate = f"{count(contender.rates.median)} steps/s"
                    await progress.show(done, partial("{}: {}".format, contender.words, rate))
        except Exception as failure:  # noqa: BLE001  # Of a baseline, the simulator's own.
            error = failure
            for contender in own:
                contender.failure = _in_words(failure)
    if error is not None and not any(contender.rounds for contender in contenders):
        raise error if isinstance(error, RLightningError) else RLightningError(_in_words(error))


def _in_words(error: Exception) -> str:
    if isinstance(error, RLightningError):
        return in_words(error).partition("\n")[0]
    return f"{type(error).__name__}: {error}"


# -- output ----------------------------------------------------------------------------------


def _report(order: _Order, configs: Sequence[EnvConfig], *, interrupted: bool) -> None:
    """Print and draw the figures."""
    contenders = order.contenders
    best = max(
        (one for one in contenders if isinstance(one.place, Setting)),
        key=attrgetter("rates.median"),
    )
    if order.as_json:
        backends = [ENVS.described(config.backend) for config in configs]
        print_json(
            {
                "config": str(order.path),
                "interrupted": interrupted,
                **machine_facts(backend.module for backend in backends if backend is not None),
                "contenders": [contender.as_json() for contender in contenders],
                "best": best.as_json() if best.rounds else None,
            }
        )
    else:
        if best.rounds:
            assert isinstance(best.place, Setting)
            call = f"{best.place.overrides()}, {best.rule.call}"
            print_lines([f"Fastest: {call}{_times(order, best)}"])
        _print_table(order, interrupted=interrupted)
    if order.plot is not None:
        draw_contenders(str(order.path), contenders, order.plot)


def _times(order: _Order, best: Contender) -> str:
    """Compare with the fastest that is no group of ours."""
    others = [one for one in order.contenders if one.rounds and isinstance(one.place, Baseline)]
    if not others:
        return ""
    other = max(others, key=attrgetter("rates.median"))
    times = best.rates.median / other.rates.median
    return f": {times:.2g} times as many steps/s as {other.place.words}"


def _print_table(order: _Order, *, interrupted: bool) -> None:
    fastest = max(order.contenders, key=attrgetter("rates.median"))
    title = (
        f"{'Interrupted: ' if interrupted else ''}{order.path}: {counted(num_cores(), 'core')}, "
        f"medians of {counted(len(fastest.rounds), 'round')}"
    )
    columns = ("envs in", "results", "steps/s", "±", "latency p50", "p99")
    table = named_columns(title, *columns, texts=["results"])
    for contender in order.contenders:
        style = "bold" if contender is fastest else None
        table.add_row(contender.place.words, contender.rule.words, *_cells(contender), style=style)
    print_table(table)
    failures = {c.place.words: c.failure for c in order.contenders if c.failure}
    print_lines(f"{words}: {failure}" for words, failure in failures.items())
    restarts = Counter[str]()
    for contender in order.contenders:
        restarts[contender.place.words] += contender.restarts
    print_lines(
        f"{words}: {counted(times, 'restart')} of a worker that died"
        for words, times in (+restarts).items()
    )


def _cells(contender: Contender) -> list[Any]:
    if not contender.rounds:
        return ["-"] * 4
    spread = f"{contender.rates.spread:.0%}" if len(contender.rounds) > 1 else "-"
    rate = count(contender.rates.median)
    return [rate, spread, *map(duration, contender.latency_us)]
