"""Suggest a faster setting from measured times.

Rule: a hint is a guess from a few numbers; ``rlightning-aio tune`` measures.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rlightning_aio.config import EnvConfig

__all__ = ["HINT_AFTER_BATCHES", "hint"]

HINT_AFTER_BATCHES: Final = 1000
_SHORT_US: Final = 1000.0
"""Limit of steps that compute, as in simulators; robots wait longer."""
_TINY_US: Final = 30.0


def hint(
    configs: Sequence[EnvConfig],
    num_workers: Mapping[str, int],
    num_cores: int,
    latency_us: Mapping[str, Mapping[str, Any]],
) -> str | None:
    """A message that suggests a faster setting, or None.

    Args:
        configs: the entries.
        num_workers: workers of each entry, by its name.
        num_cores: cores that this process and its workers may use.
        latency_us: from `EnvGroup.get_stats`; empty before anything was measured.
    """
    if not latency_us:
        return None
    step, transfer = (float(latency_us[kind]["p50"]) for kind in ("step", "transfer"))
    measured = f"a step takes {step:.0f} µs and its transfer {transfer:.0f} µs"
    for config in configs:
        workers = num_workers.get(config.name, 0)
        if workers > num_cores and workers > 1 and step < min(_SHORT_US, 10 * transfer):
            return (
                f"{measured}, and entry {config.name!r} has {workers} workers for {num_cores} "
                f"cores: several envs in each (envs_per_process: "
                f"{-(-config.num_workers // num_cores)}) would be faster"
            )
        if config.num_workers == 1 and workers == 1 and step < _TINY_US and transfer > 2 * step:
            return (
                f"{measured}: entry {config.name!r} would be faster in this process "
                "(placement: inline)"
            )
    return None
