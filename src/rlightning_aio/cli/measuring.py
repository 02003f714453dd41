"""Speed and latency of one config under several settings, in alternating rounds.

Rule: what is compared is measured in turns (A B C A B C …) with all groups open, and told
as medians over the rounds, so that a machine that is busy for a while slows all of them.
A group that waits for its turn sleeps. Actions are random, and finished episodes are reset.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from dataclasses import dataclass, field
from statistics import median
from typing import TYPE_CHECKING, Any, Final

import numpy as np

import rlightning_aio
from rlightning_aio.batch import BatchedData
from rlightning_aio.batch.data import parts_of
from rlightning_aio.cli.collecting import Roster, resetting, respond_to_all, responder
from rlightning_aio.cli.rollout_statistics import RolloutStatistics
from rlightning_aio.cli.terminal import counted
from rlightning_aio.config import moved
from rlightning_aio.errors import ConfigError, RLightningError
from rlightning_aio.registry import BACKENDS

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.group.aio import EnvGroup

__all__ = [
    "Contender",
    "Limits",
    "Round",
    "Rule",
    "Setting",
    "Stand",
    "num_cores",
    "opened",
    "possible_settings",
    "take_turns",
]

_MANY_WORKERS: Final = 32
"""More are not tried: starting them takes longer than it teaches."""


def num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


@dataclass(frozen=True, eq=False)
class Setting:
    """Where the envs live. One is itself alone: fields of a config need not be hashable.

    Attributes:
        configs: the entries with their placement and envs_per_process.
    """

    configs: tuple[EnvConfig, ...]

    @property
    def inline(self) -> bool:
        """Whether they live in this process."""
        return all(config.placement == "inline" for config in self.configs)

    @property
    def workers(self) -> int:
        """Worker processes in all."""
        return 0 if self.inline else sum(_num_workers(config) for config in self.configs)

    @property
    def words(self) -> str:
        """How tables call it."""
        if self.inline:
            return "inline"
        return counted(self.workers, "worker")

    def as_json(self) -> dict[str, Any]:
        """The fields that make it."""
        return {
            "placement": "inline" if self.inline else "process",
            "workers": self.workers,
            "envs_per_process": (
                {} if self.inline else {c.name: c.envs_per_process for c in self.configs}
            ),
        }


def _num_workers(config: EnvConfig) -> int:
    assert isinstance(config.envs_per_process, int)
    return -(-config.num_workers // config.envs_per_process)


def possible_settings(configs: Sequence[EnvConfig]) -> list[Setting]:
    """The settings worth trying: this process, and several numbers of workers for each entry.

    Raises:
        ConfigError: an entry's envs don't live where the command could choose.
    """
    for config in configs:
        if config.backend == "env_server" or config.placement == "ray":
            raise ConfigError(
                f"entry {config.name!r}: its envs live elsewhere, so there is nothing to choose; "
                "use rollout to measure it as it is"
            )
    settings: dict[int, Setting] = {}
    for count in _worker_counts(configs):
        setting = Setting(tuple(_with_workers(config, count) for config in configs))
        settings.setdefault(setting.workers, setting)
    if not any(config.interpreter or config.env_vars for config in configs):
        settings[0] = Setting(tuple(moved(config, "inline") for config in configs))
    return list(settings.values())


def _worker_counts(configs: Sequence[EnvConfig]) -> list[int]:
    most, cores = max(config.num_workers for config in configs), num_cores()
    counts = {1, cores // 2, cores, 2 * cores, min(most, _MANY_WORKERS)}
    return sorted(count for count in counts if 1 <= count <= most)


def _with_workers(config: EnvConfig, count: int) -> EnvConfig:
    backend = BACKENDS.get(config.backend)
    if backend is not None and not backend.cpu_bound:
        # A simulator with a device or threads of its own shares no process.
        count = config.num_workers
    per_process = -(-config.num_workers // count) if count < config.num_workers else 1
    return config.model_copy(update={"placement": "process", "envs_per_process": per_process})


@dataclass(frozen=True)
class Rule:
    """When results are taken.

    Attributes:
        words: how tables call it.
        min_results: of `collect_async`; None for a synchronous `step` of all envs.
    """

    words: str
    min_results: int | None


@dataclass(frozen=True)
class Limits:
    """A measurement ends at the first of these, but not before the first step."""

    steps: int
    seconds: float

    def not_reached(self, steps: int, seconds: float) -> bool:
        """Whether to go on, after so many steps in so many seconds."""
        return steps == 0 or (steps < self.steps and seconds < self.seconds)


@dataclass(frozen=True)
class Round:
    """One measurement.

    Attributes:
        latency_us: from an action's sending to its result in hand, p50 and p99.
    """

    steps_per_second: float
    latency_us: tuple[float, float]


@dataclass
class Contender:
    """A setting under a rule, and what was measured of it."""

    setting: Setting
    rule: Rule
    rounds: list[Round] = field(default_factory=list[Round])
    failure: str | None = None

    @property
    def steps_per_second(self) -> float:
        """Median over the rounds; 0 if there was none."""
        return median(r.steps_per_second for r in self.rounds) if self.rounds else 0.0

    @property
    def spread(self) -> tuple[float, float]:
        """Slowest and fastest round."""
        rates = [r.steps_per_second for r in self.rounds]
        return min(rates), max(rates)

    @property
    def latency_us(self) -> tuple[float, float]:
        """Medians of the rounds' p50 and p99."""
        return (
            median(r.latency_us[0] for r in self.rounds),
            median(r.latency_us[1] for r in self.rounds),
        )

    def as_json(self) -> dict[str, Any]:
        """All that is known of it."""
        document: dict[str, Any] = {
            **self.setting.as_json(),
            "rule": self.rule.words,
            "min_results": self.rule.min_results,
            "failure": self.failure,
            "rounds": [r.steps_per_second for r in self.rounds],
        }
        if self.rounds:
            p50, p99 = self.latency_us
            document |= {
                "steps_per_second": self.steps_per_second,
                "latency_us": {"p50": p50, "p99": p99},
            }
        return document


class Stand:
    """An open group that waits to be measured: all its envs are idle between measurements.

    Args:
        group: initialised, inside `resetting`.
        everyone: a batch of all its envs, to which random actions respond again and again.
    """

    def __init__(
        self, group: EnvGroup, setting: Setting, roster: Roster, everyone: BatchedData
    ) -> None:
        self._group = group
        self._respond = responder(group, roster, None, 0)
        self._everyone = everyone
        self._sent_at = np.zeros(len(everyone))
        self.statistics = RolloutStatistics(setting.configs)
        self.statistics.begin(roster)

    async def measure(self, rule: Rule, limits: Limits) -> Round:
        """One measurement, of full length after a few steps that warm the caches."""
        one_round = self._step if rule.min_results is None else self._collect
        await one_round(rule.min_results or 0, Limits(limits.steps, limits.seconds / 10))
        return await one_round(rule.min_results or 0, limits)

    async def _step(self, ignored: int, limits: Limits) -> Round:
        del ignored
        latencies: list[float] = []
        first, began = self.statistics.steps, time.monotonic()
        now = began
        while limits.not_reached(self.statistics.steps - first, now - began):
            responses = _joined(await self._respond(self._everyone))
            sent_at = time.monotonic()
            batch, _ = await self._group.step(responses)
            now = time.monotonic()
            latencies.append(now - sent_at)
            self.statistics.add(batch)
        return _as_round(self.statistics.steps - first, now - began, np.array(latencies))

    async def _collect(self, min_results: int, limits: Limits) -> Round:
        latencies: list[NDArray[np.float64]] = []
        group, sent_at = self._group, self._sent_at
        first, began = self.statistics.steps, time.monotonic()
        now = began
        sent_at[:] = now
        await respond_to_all(group, self._respond, self._everyone)
        while limits.not_reached(self.statistics.steps - first, now - began):
            batch, _ = await group.collect_async(min_results=min_results)
            now = time.monotonic()
            self.statistics.add(batch)
            for part in parts_of(batch):
                latencies.append(now - sent_at[part.slots])
                sent_at[part.slots] = now
            await respond_to_all(group, self._respond, batch)
        steps = self.statistics.steps - first
        batch, _ = await group.collect_async(wait_all=True)
        self.statistics.add(batch)
        return _as_round(steps, now - began, np.concatenate(latencies))


def _as_round(steps: int, seconds: float, latencies: NDArray[np.float64]) -> Round:
    p50, p99 = np.percentile(latencies, [50, 99]) * 1e6
    return Round(steps / seconds, (float(p50), float(p99)))


def _joined(responses: list[BatchedData]) -> BatchedData:
    """One batch of all responses, as `step` wants it."""
    if len(responses) == 1:
        return responses[0]
    values = [value for batch in responses for value in batch.values()]
    return BatchedData([value.env_id for value in values], values)


async def _open(stack: contextlib.AsyncExitStack, setting: Setting) -> Stand:
    group = rlightning_aio.build_env_group(list(setting.configs), mixed_actions=True)
    await stack.enter_async_context(group)
    roster = Roster(group, await group.init())
    everyone, _ = await group.reset(seed=0)
    stack.enter_context(resetting(group, setting.configs))
    return Stand(group, setting, roster, everyone)


@contextlib.asynccontextmanager
async def opened(settings: Sequence[Setting]) -> AsyncGenerator[dict[Setting, Stand | str]]:
    """Groups for all settings, open at once; a message for each that could not start.

    Raises:
        RLightningError: none could.
    """
    async with contextlib.AsyncExitStack() as stack:
        stands: dict[Setting, Stand | str] = {}
        error: RLightningError | None = None
        for setting in settings:
            try:
                stands[setting] = await _open(stack, setting)
            except RLightningError as failure:
                error = failure
                stands[setting] = str(failure).partition("\n")[0]
        if error is not None and not any(isinstance(s, Stand) for s in stands.values()):
            raise error
        yield stands


async def take_turns(
    stands: dict[Setting, Stand | str],
    contenders: Sequence[Contender],
    rounds: int,
    limits: Limits,
    tell: Callable[[Contender], None],
) -> None:
    """Measure all contenders in turn, `rounds` times; `tell` is called after each."""
    for _ in range(rounds):
        for contender in contenders:
            stand = stands[contender.setting]
            if isinstance(stand, Stand):
                contender.rounds.append(await stand.measure(contender.rule, limits))
            else:
                contender.failure = stand
            tell(contender)
            await asyncio.sleep(0)  # Ctrl-C gets its turn.
