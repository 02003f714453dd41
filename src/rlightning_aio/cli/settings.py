"""The settings that `bench` tries for a config.

Rule: without `--sweep`, every setting steps the same number of simulations as the config, with one
or several in each env, in this process, in workers, or in both. With it, the settings are all
combinations of the values that the user gives.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio._core.group.setup.start_orders import nums_hosts
from rlightning_aio.cli.measuring import Place, opened_group
from rlightning_aio.cli.terminal import counted
from rlightning_aio.config import load_config, moved
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import ENVS, PLACEMENTS
from rlightning_aio.sharing import num_batches, num_cores

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from contextlib import AbstractAsyncContextManager
    from pathlib import Path

    from rlightning_aio.cli.measuring import Measure
    from rlightning_aio.config import EnvConfig

_MANY_WORKERS: Final = 32
"""Largest number of workers to try; starting more takes too long."""


@dataclass(frozen=True, eq=False)
class Setting(Place):
    """A placement of a config's envs. Compared by identity, as configs may not be hashable.

    Attributes:
        configs: the entries with their placement, envs_per_process, num_workers and num_envs.
    """

    configs: tuple[EnvConfig, ...]
    words: str

    @property
    def num_envs(self) -> int:
        """Return the total number of envs, and so of results of one step of all."""
        return sum(config.num_workers for config in self.configs)

    @property
    def placement(self) -> str:
        """Return the placement, or those of the entries if they differ."""
        return " + ".join(dict.fromkeys(config.placement for config in self.configs))

    @property
    def has_workers(self) -> bool:
        """Return True if some of the envs are in worker processes."""
        return any(PLACEMENTS[config.placement].spreads for config in self.configs)

    @property
    def workers(self) -> int:
        """Return the total number of worker processes."""
        counts = zip(self.configs, nums_hosts(self.configs, num_cores()), strict=True)
        return sum(count for config, count in counts if PLACEMENTS[config.placement].spreads)

    def overrides(self) -> str:
        """Return the arguments of a command that make this setting of the config."""
        fields = ["placement", "num_workers", "num_envs"]
        fields += ["envs_per_process"] if self.has_workers else []
        return " ".join(
            f"envs.{k}.{name}={getattr(config, name)}"
            for k, config in enumerate(self.configs)
            for name in fields
        )

    def opened(self, seed: int | None) -> AbstractAsyncContextManager[Measure]:
        return opened_group(self.configs, seed)

    def as_json(self) -> dict[str, Any]:
        """Return the fields that define it, for JSON."""
        return {
            "placement": self.placement,
            "workers": self.workers,
            "envs_per_process": (
                {c.name: c.envs_per_process for c in self.configs} if self.has_workers else {}
            ),
            "num_workers": {c.name: c.num_workers for c in self.configs},
            "num_envs": {c.name: c.num_envs for c in self.configs},
        }


def possible_settings(configs: Sequence[EnvConfig]) -> list[Setting]:
    """Return the settings worth trying.

    The envs as configured: in several numbers of workers, and in this process. Then, for
    simulators that step several simulations in one env (``num_envs``), the same simulations in one
    env for each core, in workers, and all in one env in this process. Awaitable envs of the event
    loop: there and, without `max_concurrency`, in several numbers of workers.

    Raises:
        ConfigError: an entry's placement can't be chosen.
    """
    _check_choosable(configs)
    settings: dict[tuple[object, ...], Setting] = {}
    for setting in _candidates(configs, num_cores()):
        sizes = tuple(config.num_workers for config in setting.configs)
        settings.setdefault((setting.placement, setting.workers, sizes), setting)
    return list(settings.values())


def swept_settings(
    path: Path, overrides: Sequence[str], sweeps: Mapping[str, Sequence[str]]
) -> list[Setting]:
    """Return a setting for each combination of values.

    Args:
        path: the config's file.
        overrides: of its fields.
        sweeps: the values of each field. Without ``envs.0.`` it is that of all entries.

    Raises:
        ConfigError: a combination is no config, or an entry's placement can't be chosen.
    """
    num_entries = len(load_config(path, overrides))
    settings: list[Setting] = []
    for values in itertools.product(*sweeps.values()):
        chosen = dict(zip(sweeps, values, strict=True))
        configs = load_config(
            path,
            [
                *overrides,
                *(
                    f"{name if name.startswith('envs.') else f'envs.{k}.{name}'}={value}"
                    for name, value in chosen.items()
                    for k in range(num_entries)
                ),
            ],
        )
        _check_choosable(configs)
        words = ", ".join(f"{name}={value}" for name, value in chosen.items())
        settings.append(Setting(tuple(configs), words or "as configured"))
    return settings


def _check_choosable(configs: Sequence[EnvConfig]) -> None:
    for config in configs:
        if config.backend == "env_server" or config.placement == "ray":
            raise ConfigError(
                f"entry {config.name!r}: its envs live elsewhere, so there is nothing to choose; "
                "use rollout to measure it"
            )
        if config.is_hardware:
            raise ConfigError(
                f"entry {config.name!r}: its envs move something real, and not all that bench "
                "compares would stop them; use rollout to measure it"
            )


def _candidates(configs: Sequence[EnvConfig], cores: int) -> Iterator[Setting]:
    if any(config.placement == "loop" for config in configs):
        yield from _awaiting(configs, cores)
        return
    here = not any(config.interpreter or config.env_vars for config in configs)
    for count in _worker_counts(configs, cores):
        yield _in_workers(configs, count)
    if here:
        yield _inline(configs)
    for num_shares in (1, cores):
        batched = [_batched(config, num_shares) for config in configs]
        if batched == list(configs):
            continue
        yield _in_workers(batched, num_shares)
        if here and num_shares == 1:
            yield _inline(batched)


def _awaiting(configs: Sequence[EnvConfig], cores: int) -> Iterator[Setting]:
    if all(config.placement == "loop" for config in configs):
        yield Setting(tuple(configs), "loop" + _sizes(configs))
    if any(config.max_concurrency for config in configs):
        return  # It protects something, and workers have no such limit.
    placed = [moved(config, "process") for config in configs]
    for count in _worker_counts(placed, cores):
        yield _in_workers(placed, count)


def _worker_counts(configs: Sequence[EnvConfig], cores: int) -> list[int]:
    most = max(config.num_workers for config in configs)
    counts = {1, cores // 2, cores, 2 * cores, min(most, _MANY_WORKERS)}
    return sorted(count for count in counts if 1 <= count <= most)


def _in_workers(configs: Sequence[EnvConfig], count: int) -> Setting:
    placed = tuple(_shared_out(config, count) for config in configs)
    workers = counted(sum(nums_hosts(placed, num_cores())), "worker process")
    return Setting(placed, workers + _sizes(placed))


def _inline(configs: Sequence[EnvConfig]) -> Setting:
    placed = tuple(moved(config, "inline") for config in configs)
    return Setting(placed, "inline" + _sizes(placed))


def _sizes(configs: Sequence[EnvConfig]) -> str:
    if all(config.num_envs == 1 for config in configs):
        return ""
    return ", " + " + ".join(f"{config.num_workers} x {config.num_envs}" for config in configs)


def _shared_out(config: EnvConfig, count: int) -> EnvConfig:
    """Return the entry with its envs in about `count` workers."""
    backend = ENVS.described(config.backend)
    if backend is not None and not backend.cpu_bound:
        # A simulator that uses a device or its own threads needs a process for each env.
        count = config.num_workers
    per_process = -(-config.num_workers // count) if count < config.num_workers else 1
    return config.model_copy(update={"placement": "process", "envs_per_process": per_process})


def _batched(config: EnvConfig, num_shares: int) -> EnvConfig:
    """Return the entry with its simulations in about `num_shares` envs, if it supports that."""
    backend = ENVS.described(config.backend)
    vectorized = backend is not None and backend.vectorized and backend.cpu_bound
    if not vectorized or config.backend == "callable" or ENVS.registered(config.backend):
        return config
    total = config.num_workers * config.num_envs
    count = num_batches(total, num_shares)
    return config.model_copy(update={"num_workers": count, "num_envs": total // count})
