"""The best of the settings that `bench` has measured, and the config that uses it.

Rule: a config tells where envs live, not how many results to wait for, which is an argument of a
call; so a comment at its top says that.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import yaml

from rlightning_aio.cli.bench.settings import Setting
from rlightning_aio.cli.option_files import naming_option
from rlightning_aio.cli.terminal import count, counted
from rlightning_aio.files import write_file
from rlightning_aio.sharing import num_cores

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from rlightning_aio.cli.bench.measuring import Contender

__all__ = ["best_of", "verdict", "write_best"]

_NOISE: Final = 0.03
"""Contenders within this share of the fastest count as equally fast."""


def best_of(contenders: Iterable[Contender]) -> Contender | None:
    """Return the fastest group; of equally fast ones, that with the lowest latency."""
    measured = [c for c in contenders if c.rounds and isinstance(c.setting, Setting)]
    fastest = max((contender.steps_per_second for contender in measured), default=0.0)
    as_fast = [c for c in measured if c.steps_per_second >= fastest * (1 - _NOISE)]
    return min(as_fast, key=lambda contender: contender.latency_us, default=None)


def verdict(best: Contender, contenders: Iterable[Contender]) -> str:
    """Return a sentence on the best setting, compared with the fastest that is no group of ours."""
    words = f"Best: {best.setting.words}, {best.rule.words}: {count(best.steps_per_second)} steps/s"
    others = [c for c in contenders if c.rounds and not isinstance(c.setting, Setting)]
    if others:
        other = max(others, key=lambda contender: contender.steps_per_second)
        times = best.steps_per_second / other.steps_per_second
        words += f", {times:.2g} times as many as {other.setting.words}"
    return f"{words}."


def write_best(path: Path, config: Path, best: Contender, *, interrupted: bool) -> None:
    """Write the config with the best setting.

    Raises:
        ConfigError: the file can't be written.
    """
    with naming_option("--best", path):
        write_file(path, _as_yaml(config, best, interrupted=interrupted).encode())


def _as_yaml(config: Path, best: Contender, *, interrupted: bool) -> str:
    setting = best.setting
    assert isinstance(setting, Setting)
    entries: list[dict[str, Any]] = [
        {
            # Only the given fields: a default may be that of hardware, or have no meaning here.
            **entry.model_dump(
                mode="json", exclude_defaults=True, include=set(entry.model_fields_set)
            ),
            "placement": entry.placement,
            **({"envs_per_process": entry.envs_per_process} if setting.has_workers else {}),
        }
        for entry in setting.configs
    ]
    text = yaml.safe_dump({"envs": entries}, sort_keys=False, allow_unicode=True)
    least = best.rule.min_results
    call = "step(batch)" if least is None else f"collect_async(min_results={least})"
    lines = [
        f"The best setting for {config} on {counted(num_cores(), 'core')}:",
        f"{count(best.steps_per_second)} steps/s with {call}.",
    ]
    if interrupted:
        lines.insert(0, "Interrupted: not everything was measured.")
    if any(entry.num_envs > 1 for entry in setting.configs):
        lines.append("With num_envs, a result covers that many sub-environments: columns are")
        lines.append("[results, num_envs, ...], such as batch.observation, and actions, too.")
    return "".join(f"# {line}\n" for line in lines) + text
