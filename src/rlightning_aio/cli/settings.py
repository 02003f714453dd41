"""Where a config's envs could live: what `bench` and `tune` try.

Rule: every setting steps as many simulations as the config has, in envs of one or of several of
them, in this process, in workers, or in both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.cli.terminal import counted
from rlightning_aio.config import moved
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import BACKENDS, ENVS
from rlightning_aio.sharing import num_batches, num_cores

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.config import EnvConfig

__all__ = ["Setting", "possible_settings"]

_MANY_WORKERS: Final = 32
"""More are not tried: starting them takes longer than it teaches."""


@dataclass(frozen=True, eq=False)
class Setting:
    """Where the envs live. One is itself alone: fields of a config need not be hashable.

    Attributes:
        configs: the entries with their placement, envs_per_process, num_workers and num_envs.
        words: how tables call it.
    """

    configs: tuple[EnvConfig, ...]
    words: str

    @property
    def num_envs(self) -> int:
        """Envs in all, and so results of one step of all."""
        return sum(config.num_workers for config in self.configs)

    @property
    def placement(self) -> str:
        """Where they live, for all entries alike."""
        return self.configs[0].placement

    @property
    def workers(self) -> int:
        """Worker processes in all."""
        if self.placement == "inline":
            return 0
        return sum(_num_shares(c) - (c.placement == "split") for c in self.configs)

    def as_json(self) -> dict[str, Any]:
        """The fields that make it."""
        return {
            "placement": self.placement,
            "workers": self.workers,
            "envs_per_process": (
                {}
                if self.placement == "inline"
                else {c.name: c.envs_per_process for c in self.configs}
            ),
            "num_workers": {c.name: c.num_workers for c in self.configs},
            "num_envs": {c.name: c.num_envs for c in self.configs},
        }


def _num_shares(config: EnvConfig) -> int:
    assert isinstance(config.envs_per_process, int)
    return -(-config.num_workers // config.envs_per_process)


def possible_settings(configs: Sequence[EnvConfig]) -> list[Setting]:
    """The settings worth trying.

    The envs as they are configured: in several numbers of workers, in this process, in both. Then,
    of simulators that step several simulations in one env (``num_envs``), the same simulations
    in one env for each core, in workers or in both, and all in one env in this process.

    Raises:
        ConfigError: an entry's envs don't live where the command could choose.
    """
    for config in configs:
        if config.backend == "env_server" or config.placement == "ray":
            raise ConfigError(
                f"entry {config.name!r}: its envs live elsewhere, so there is nothing to choose; "
                "use rollout to measure it as it is"
            )
    cores = num_cores()
    here = not any(config.interpreter or config.env_vars for config in configs)
    found = [_in_workers(configs, count) for count in _worker_counts(configs, cores)]
    if here:
        found += [_inline(configs), _split(configs, cores)]
    for num_shares in (1, cores):
        batched = [_batched(config, num_shares) for config in configs]
        if batched == list(configs):
            continue
        found += [_in_workers(batched, num_shares)]
        if here:
            found += [_inline(batched) if num_shares == 1 else _split(batched, cores)]
    settings: dict[tuple[object, ...], Setting] = {}
    for setting in found:
        if setting is not None:
            sizes = tuple(config.num_workers for config in setting.configs)
            settings.setdefault((setting.placement, setting.workers, sizes), setting)
    return list(settings.values())


def _worker_counts(configs: Sequence[EnvConfig], cores: int) -> list[int]:
    most = max(config.num_workers for config in configs)
    counts = {1, cores // 2, cores, 2 * cores, min(most, _MANY_WORKERS)}
    return sorted(count for count in counts if 1 <= count <= most)


def _in_workers(configs: Sequence[EnvConfig], count: int) -> Setting:
    placed = tuple(_shared_out(config, count, "process") for config in configs)
    return Setting(placed, counted(sum(map(_num_shares, placed)), "worker") + _sizes(placed))


def _inline(configs: Sequence[EnvConfig]) -> Setting:
    placed = tuple(moved(config, "inline") for config in configs)
    return Setting(placed, "inline" + _sizes(placed))


def _split(configs: Sequence[EnvConfig], cores: int) -> Setting | None:
    """As many shares as there are cores, one of them in this process; None where one can't be."""
    if cores == 1 or any(c.num_workers == 1 or not ENVS.is_cpu_bound(c.backend) for c in configs):
        return None
    placed = tuple(_shared_out(moved(config, "split"), cores, "split") for config in configs)
    workers = sum(_num_shares(config) - 1 for config in placed)
    return Setting(placed, f"split, {counted(workers, 'worker')}{_sizes(placed)}")


def _sizes(configs: Sequence[EnvConfig]) -> str:
    if all(config.num_envs == 1 for config in configs):
        return ""
    return ", " + " + ".join(f"{config.num_workers} x {config.num_envs}" for config in configs)


def _shared_out(config: EnvConfig, count: int, placement: str) -> EnvConfig:
    backend = BACKENDS.get(config.backend)
    if backend is not None and not backend.cpu_bound:
        # A simulator with a device or threads of its own shares no process.
        count = config.num_workers
    per_process = -(-config.num_workers // count) if count < config.num_workers else 1
    return config.model_copy(update={"placement": placement, "envs_per_process": per_process})


def _batched(config: EnvConfig, num_shares: int) -> EnvConfig:
    """The entry with its simulations in so many envs, or about, where its simulator can do that."""
    backend = BACKENDS.get(config.backend)
    vectorized = backend is not None and backend.vectorized and backend.cpu_bound
    if not vectorized or config.backend == "callable" or ENVS.registered(config.backend):
        return config
    total = config.num_workers * config.num_envs
    count = num_batches(total, num_shares)
    # A number of results that was set was for other envs.
    return config.model_copy(
        update={"num_workers": count, "num_envs": total // count, "min_results": None}
    )
