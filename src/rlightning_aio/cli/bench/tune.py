"""``rlightning-aio tune`` finds the fastest setting for a config's envs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path  # noqa: TC003 (Typer reads annotations)
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
import yaml

from rlightning_aio.cli.bench.apart import opened
from rlightning_aio.cli.bench.bench import Watch
from rlightning_aio.cli.bench.contender_table import print_contenders
from rlightning_aio.cli.bench.measuring import Contender, Limits, Rule, take_turn, take_turns
from rlightning_aio.cli.bench.settings import Setting, possible_settings
from rlightning_aio.cli.options import Config, MeasuringSeconds, Overrides, Rounds
from rlightning_aio.cli.terminal import (
    count,
    counted,
    duration,
    err,
    print_json,
    print_result,
    run_interruptible,
)
from rlightning_aio.config import load_config
from rlightning_aio.sharing import num_cores

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.cli.bench.measuring import Stands
    from rlightning_aio.config import EnvConfig

__all__ = ["tune"]

_NOISE: Final = 0.03
"""Settings within this share of the fastest count as equally fast."""

_FINALISTS: Final = 2
"""Number of settings for which several values of min_results are tried."""


@dataclass
class _Search:
    """The contenders and the results so far.

    Attributes:
        places: all settings, under one rule.
        finals: the fastest settings, under several rules.
        step_us: mean time in an env's own step, with one worker alone.
        core_us: time for which this step keeps cores busy, including the trainer's part.
    """

    configs: Sequence[EnvConfig]
    rounds: int
    limits: Limits
    places: list[Contender] = field(default_factory=list[Contender])
    finals: list[Contender] = field(default_factory=list[Contender])
    step_us: float | None = None
    core_us: float | None = None

    @property
    def num_envs(self) -> int:
        return sum(config.num_workers for config in self.configs)

    @property
    def sub_envs(self) -> int:
        """Return the number of env steps in one step of all envs."""
        return sum(config.num_workers * config.num_envs for config in self.configs)

    @property
    def waits(self) -> bool:
        """Return True if an env spends most of its step waiting, without using the core."""
        return bool(self.step_us) and self.core_us is not None and self.core_us < self.step_us / 2

    @property
    def limit(self) -> float | None:
        """Return the steps per second of all cores if they only stepped. None if this is no limit:
        envs wait, or several simulations in one env take less time each.
        """
        if not self.step_us or self.waits:
            return None
        limit = num_cores() * 1e6 / self.step_us * self.sub_envs / self.num_envs
        return limit if limit >= self.best.steps_per_second else None

    @property
    def best(self) -> Contender:
        """Return the fastest contender; of equally fast ones, that with the lowest latency."""
        finals = [contender for contender in self.finals if contender.rounds]
        measured = finals or [contender for contender in self.places if contender.rounds]
        fastest = max(contender.steps_per_second for contender in measured)
        as_fast = [c for c in measured if c.steps_per_second >= fastest * (1 - _NOISE)]
        return min(as_fast, key=lambda contender: contender.latency_us)


def tune(
    config: Config,
    overrides: Overrides = None,
    rounds: Rounds = 5,
    seconds: MeasuringSeconds = 0.5,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document instead of the YAML.")
    ] = False,
) -> None:
    """Find where a config's envs should live, and how many results to wait for.

    It first measures a step of the envs alone. Then it tries this process, several numbers of
    worker processes and both together, with one simulation in each env or several (num_envs),
    and then several `min_results` with the two fastest of these, all in alternating rounds. It
    prints the config with the best setting as YAML on stdout, and the table of all settings on
    stderr. Among equally fast settings, the one with the lowest latency is best. Actions
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
        with Watch(len(settings), measurements) as watch:
            run_interruptible(_search(search, settings, watch))
    except KeyboardInterrupt:
        interrupted = True
        raise
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


async def _measure_env(search: _Search, settings: Sequence[Setting], stands: Stands) -> None:
    """Measure a step with one worker alone."""
    for setting in settings:
        alone = Contender(setting, Rule("step", None))
        await take_turn(stands, alone, search.limits)
        for measured in alone.rounds:
            steps_per_second = measured.steps_per_second * search.num_envs / search.sub_envs
            search.step_us = measured.step_us
            search.core_us = measured.cores / steps_per_second * 1e6
            return


def _setting(contender: Contender) -> Setting:
    assert isinstance(contender.setting, Setting)
    return contender.setting


def _waiting_for(least: int) -> Rule:
    return Rule(f"min_results={least}", least)


def _least(num_envs: int) -> list[int]:
    """Return the values of min_results worth trying."""
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
    if search.waits:
        console.print(
            f"A step takes {duration(search.step_us)} in the env, most of it waiting: "
            "the number of cores is no limit, so try more worker processes."
        )
    elif search.limit is not None:
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
            # Only the given fields: a default may be that of hardware, or have no meaning here.
            **entry.model_dump(
                mode="json", exclude_defaults=True, include=set(entry.model_fields_set)
            ),
            "placement": entry.placement,
            **({"envs_per_process": entry.envs_per_process} if setting.has_workers else {}),
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
        lines.append("With num_envs, a result covers that many sub-environments: columns are")
        lines.append("[results, num_envs, ...], such as batch.observation, and actions, too.")
    return ("".join(f"# {line}\n" for line in lines) + text).rstrip()


def _dealt_out(wanted: int, sizes: Sequence[int]) -> list[int]:
    """Return `wanted` results divided among entries in proportion to their envs."""
    total, parts, before = sum(sizes), list[int](), 0
    for size in sizes:
        parts.append(wanted * (before + size) // total - wanted * before // total)
        before += size
    return parts
