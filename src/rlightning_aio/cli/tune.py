"""``rlightning-aio tune``: find the setting under which a config's envs go fastest."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from pathlib import Path  # noqa: TC003 (Typer reads annotations)
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
import yaml

import rlightning_aio
from rlightning_aio.cli.bench import Watch
from rlightning_aio.cli.contender_table import print_contenders
from rlightning_aio.cli.measuring import Contender, Limits, Rule, Stand, opened, take_turns
from rlightning_aio.cli.options import Config, Overrides
from rlightning_aio.cli.settings import Setting, possible_settings
from rlightning_aio.cli.terminal import (
    INTERRUPTED,
    count,
    counted,
    duration,
    err,
    interruptible,
    print_json,
    print_result,
)
from rlightning_aio.config import load_config
from rlightning_aio.sharing import num_cores

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.cli.measuring import Measurable, Place
    from rlightning_aio.config import EnvConfig

__all__ = ["tune"]

_NOISE: Final = 0.03
"""Settings within this share of the fastest count as equally fast."""

_FINALISTS: Final = 2
"""Settings whose min_results are tried."""


@dataclass
class _Search:
    """What is tried, and what was found out on the way.

    Attributes:
        places: all settings, under one rule.
        finals: the fastest settings, under several rules.
        step_us: time in an env's own step, mean, with one worker at work alone.
    """

    configs: Sequence[EnvConfig]
    rounds: int
    limits: Limits
    places: list[Contender] = field(default_factory=list[Contender])
    finals: list[Contender] = field(default_factory=list[Contender])
    step_us: float | None = None

    @property
    def num_envs(self) -> int:
        return sum(config.num_workers for config in self.configs)

    @property
    def sub_envs(self) -> int:
        """Environment steps in one round of all envs."""
        return sum(config.num_workers * config.num_envs for config in self.configs)

    @property
    def limit(self) -> float | None:
        """Steps per second of all cores, if they did nothing but step."""
        if not self.step_us:
            return None
        return num_cores() * 1e6 / self.step_us * self.sub_envs / self.num_envs

    @property
    def best(self) -> Contender:
        """The fastest; of those that are as fast, the one with the lowest latency."""
        finals = [contender for contender in self.finals if contender.rounds]
        measured = finals or [contender for contender in self.places if contender.rounds]
        fastest = max(contender.steps_per_second for contender in measured)
        as_fast = [c for c in measured if c.steps_per_second >= fastest * (1 - _NOISE)]
        return min(as_fast, key=lambda contender: contender.latency_us)


def tune(
    config: Config,
    overrides: Overrides = None,
    rounds: Annotated[int, typer.Option(min=1, help="Number of turns for each setting.")] = 5,
    seconds: Annotated[
        float, typer.Option(min=0.001, help="Length of one measurement, in seconds.")
    ] = 0.5,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document instead of the YAML.")
    ] = False,
) -> None:
    """Find where a config's envs should live, and how many results to wait for.

    It first measures a step of the envs alone. Then it tries this process, several numbers of
    workers and both together, with one simulation in each env or several (num_envs), and then
    several `min_results` with the two fastest of these, all in alternating rounds. It prints the
    config with the best setting as YAML on stdout, and the table of all settings on stderr.
    Among equally fast settings, the one with the lowest latency is best. Actions
    are random: a slow policy shifts the balance towards a smaller min_results.

    For example:

        rlightning-aio tune configs/halfcheetah.yaml
        rlightning-aio tune configs/cartpole.yaml envs.0.num_workers=256 > tuned.yaml
    """
    configs = load_config(config, overrides or ())
    settings = possible_settings(configs)
    search = _Search(configs, rounds, Limits(2**62, seconds))
    measurements = rounds * (len(settings) + _FINALISTS * len(_least(search.num_envs)))
    interrupted = False
    try:
        with (
            Watch(len(settings), measurements) as watch,
            interruptible(),
            contextlib.closing(_search(search, settings, watch)) as searching,
        ):
            rlightning_aio.run(searching)
    except KeyboardInterrupt:
        interrupted = True
        raise typer.Exit(INTERRUPTED) from None
    finally:
        if any(contender.rounds for contender in search.places):
            _report(config, search, interrupted=interrupted, as_json=as_json)


async def _search(search: _Search, settings: Sequence[Setting], watch: Watch) -> None:
    async with opened(settings) as stands:
        await _measure_env(search, settings, stands)
        search.places = [
            Contender(setting, _waiting_for(max(1, setting.num_envs // 2))) for setting in settings
        ]
        watch.say(f"trying {counted(len(settings), 'setting')}, {counted(search.rounds, 'round')}")
        await take_turns(stands, search.places, search.rounds, search.limits, watch.measured)
        ranked = sorted(search.places, key=lambda contender: -contender.steps_per_second)
        search.finals = [
            Contender(contender.setting, _waiting_for(least))
            for contender in ranked[:_FINALISTS]
            if contender.rounds
            for least in _least(_setting(contender).num_envs)
        ]
        watch.say(
            f"trying {len(search.finals)} values of min_results, {counted(search.rounds, 'round')}"
        )
        await take_turns(stands, search.finals, search.rounds, search.limits, watch.measured)


async def _measure_env(
    search: _Search, settings: Sequence[Setting], stands: dict[Place, Measurable | str]
) -> None:
    """Step with one worker alone, where nothing disturbs it."""
    for setting in settings:
        stand = stands[setting]
        if isinstance(stand, Stand):
            await stand.measure(Rule("step", None), search.limits)
            search.step_us = stand.statistics.mean_step_us()
            return


def _setting(contender: Contender) -> Setting:
    assert isinstance(contender.setting, Setting)
    return contender.setting


def _waiting_for(least: int) -> Rule:
    return Rule(f"min_results={least}", least)


def _least(num_envs: int) -> list[int]:
    """The values of min_results worth trying."""
    eighths = (num_envs * share // 8 for share in (1, 2, 4, 6, 8))
    return sorted({1, *eighths} - {0})


def _report(config: Path, search: _Search, *, interrupted: bool, as_json: bool) -> None:
    best = search.best
    if as_json:
        print_json(
            {
                "config": str(config),
                "interrupted": interrupted,
                "cores": num_cores(),
                "step_us": search.step_us,
                "limit_steps_per_second": search.limit,
                "best": best.as_json(),
                "tried": [contender.as_json() for contender in search.places + search.finals],
            }
        )
        return
    console = err()
    print_contenders(console, "Where the envs live", search.places)
    if any(contender.rounds for contender in search.finals):
        print_contenders(console, "How many results to wait for", search.finals)
    if search.limit is not None:
        console.print(
            f"A step takes {duration(search.step_us)} in the env: {counted(num_cores(), 'core')} "
            f"that only step make {count(search.limit)} steps/s."
        )
    print_result(_as_yaml(config, best, interrupted=interrupted))


def _as_yaml(config: Path, best: Contender, *, interrupted: bool = False) -> str:
    setting = _setting(best)
    wanted = _dealt_out(best.rule.min_results or 1, [c.num_workers for c in setting.configs])
    entries: list[dict[str, Any]] = [
        {
            # What was given; a default may be a robot's, or mean nothing where the envs live.
            **entry.model_dump(
                mode="json", exclude_defaults=True, include=set(entry.model_fields_set)
            ),
            "placement": entry.placement,
            **({} if entry.placement == "inline" else {"envs_per_process": entry.envs_per_process}),
            **({"min_results": least} if least else {}),
        }
        for entry, least in zip(setting.configs, wanted, strict=True)
    ]
    text = yaml.safe_dump({"envs": entries}, sort_keys=False, allow_unicode=True)
    least, rate = best.rule.min_results, count(best.steps_per_second)
    lines = [
        f"{config}, tuned on {counted(num_cores(), 'core')}:",
        f"{rate} steps/s with collect_async(min_results={least}), the default with this config.",
    ]
    if interrupted:
        lines.insert(0, "Interrupted: not everything was tried.")
    if any(entry.num_envs > 1 for entry in setting.configs):
        lines.append("With num_envs, one result covers that many sub-environments.")
    return ("".join(f"# {line}\n" for line in lines) + text).rstrip()


def _dealt_out(wanted: int, sizes: Sequence[int]) -> list[int]:
    """`wanted` results over entries of so many envs, by their shares; the sum is `wanted`."""
    total, parts, before = sum(sizes), list[int](), 0
    for size in sizes:
        parts.append(wanted * (before + size) // total - wanted * before // total)
        before += size
    return parts
