"""Speed and latency of one config under several settings, in alternating rounds.

Rule: contenders take turns (A B C A B C …) with all groups open, and figures are medians over the
rounds, so other load on the machine slows all of them alike. A group that waits for its turn
sleeps. Finished episodes are reset.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np

import rlightning_aio
from rlightning_aio._core.group.api.facade import ensure_auto_reset
from rlightning_aio.batch import BatchedData
from rlightning_aio.batch.data import parts_of
from rlightning_aio.cli.measurement import Figures, cpu_seconds, in_turns, memory_bytes
from rlightning_aio.cli.policies.collecting import (
    Roster,
    respond_to_all,
    responder,
    traced,
)
from rlightning_aio.cli.rollout_statistics import RolloutStatistics
from rlightning_aio.cli.terminal import in_words
from rlightning_aio.errors import RLightningError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.cli.bench.settings import Setting
    from rlightning_aio.cli.policies.policies import Policy
    from rlightning_aio.config import EnvConfig

__all__ = [
    "Contender",
    "Costs",
    "Limits",
    "Measurable",
    "Place",
    "Round",
    "Rule",
    "Stand",
    "Stands",
    "as_round",
    "opened_group",
    "raise_if_all_failed",
    "take_turn",
    "take_turns",
]


@dataclass(frozen=True)
class Rule:
    """A rule for when results are collected.

    Attributes:
        words: its name in tables.
        min_results: the argument of `collect_async`; None for a synchronous `step` of all envs.
    """

    words: str
    min_results: int | None


@dataclass(frozen=True)
class Limits:
    """Limits of a measurement, which ends at the first of them, but after one step at least."""

    steps: int
    seconds: float

    def not_reached(self, steps: int, seconds: float) -> bool:
        """Return True if a measurement with these steps and seconds has to continue."""
        return steps == 0 or (steps < self.steps and seconds < self.seconds)


@dataclass(frozen=True)
class Round:
    """One measurement.

    Attributes:
        latency_us: time from sending an action to receiving its result, p50 and p99.
        cores: number of cores kept busy by this process and the workers.
        step_us: mean time in an env's own step so far; None where it is not known.
        restarts: number of workers that were replaced meanwhile.
    """

    steps_per_second: float
    latency_us: tuple[float, float]
    cores: float
    step_us: float | None = None
    restarts: int = 0


@dataclass(frozen=True)
class Costs:
    """Costs of envs other than those of steps.

    Attributes:
        start_seconds: time until all envs were built.
        reset_seconds: time of the first reset.
        memory_bytes: memory of their processes, or growth of this process.
    """

    start_seconds: float
    reset_seconds: float
    memory_bytes: int


class Place(Protocol):
    """A way to place and step envs."""

    @property
    def words(self) -> str:
        """Return its name in tables."""
        ...

    @property
    def configs(self) -> tuple[EnvConfig, ...]:
        """Return the entries of its envs."""
        ...

    @property
    def steps_here(self) -> bool:
        """Return True if envs of it live in the process that measures them."""
        ...

    def as_json(self) -> dict[str, Any]:
        """Return its description for JSON."""
        ...


class Measurable(Protocol):
    """Envs that can be measured."""

    costs: Costs

    async def measure(self, rule: Rule, limits: Limits, trace: Path | None = None) -> Round:
        """Measure once, after a few steps that warm the caches.

        Args:
            rule: when results are collected.
            limits: the end of the measurement.
            trace: a file for a timeline; only groups write it.

        Raises:
            RLightningError: an env, its worker or its process failed.
        """
        ...


Stands: TypeAlias = dict[Place, Measurable | RLightningError]
"""Places that are open, and the errors of those that could not start or have failed."""


@dataclass
class Contender:
    """A place with a rule, and its measurements."""

    setting: Place
    rule: Rule
    rounds: list[Round] = field(default_factory=list[Round])
    costs: Costs | None = None
    failure: str | None = None

    @property
    def steps_per_second(self) -> float:
        """Return the median over the rounds, or 0 without any."""
        return self._rates.median

    @property
    def _rates(self) -> Figures:
        return Figures([r.steps_per_second for r in self.rounds])

    @property
    def spread(self) -> float:
        """Return half the range of the rounds, as a share of the median."""
        return self._rates.spread

    @property
    def latency_us(self) -> tuple[float, float]:
        """Return the medians of the rounds' p50 and p99."""
        p50, p99 = (Figures([r.latency_us[k] for r in self.rounds]).median for k in (0, 1))
        return p50, p99

    @property
    def cores(self) -> float:
        """Return the median over the rounds of the cores that were busy."""
        return Figures([r.cores for r in self.rounds]).median

    @property
    def restarts(self) -> int:
        """Return the number of workers that were replaced in all rounds."""
        return sum(r.restarts for r in self.rounds)

    def as_json(self) -> dict[str, Any]:
        """Return all figures for JSON."""
        document: dict[str, Any] = {
            "place": self.setting.words,
            **self.setting.as_json(),
            "rule": self.rule.words,
            "min_results": self.rule.min_results,
            "failure": self.failure,
            "restarts": self.restarts,
            "rounds": self._rates.values,
        }
        if self.rounds:
            p50, p99 = self.latency_us
            document |= {
                "steps_per_second": self.steps_per_second,
                "spread": self.spread,
                "latency_us": {"p50": p50, "p99": p99},
                "cores": self.cores,
            }
        return document | ({} if self.costs is None else asdict(self.costs))


class Stand:
    """An open group to be measured; all its envs are idle between measurements.

    Args:
        group: an initialised group that resets its envs at their ends.
        everyone: a batch of all its envs, to which every action responds.
        costs: the group's costs.
        policy: the source of actions; None draws random ones from the seed.
    """

    def __init__(
        self,
        group: EnvGroup,
        setting: Setting,
        roster: Roster,
        everyone: BatchedData,
        costs: Costs,
        policy: Policy | None,
        seed: int,
    ) -> None:
        self.costs = costs
        self.group = group
        self._respond = responder(group, roster, policy, seed)
        self._everyone = everyone
        self._sent_at = np.zeros(len(everyone))
        self.statistics = RolloutStatistics(setting.configs)
        self.statistics.begin(roster)

    async def measure(self, rule: Rule, limits: Limits, trace: Path | None = None) -> Round:
        """Measure once, after a few steps that warm the caches."""
        least, before = rule.min_results, self._restarts()
        one_round = self._step if least is None else partial(self._collect, least)
        async with traced(self.group, trace):
            await one_round(Limits(limits.steps, limits.seconds / 10))
            measured = await one_round(limits)
        step_us, restarts = self.statistics.mean_step_us(), self._restarts() - before
        return replace(measured, step_us=step_us, restarts=restarts)

    def _restarts(self) -> int:
        return sum(worker["restarts"] for worker in self.group.get_workers())

    async def _step(self, limits: Limits) -> Round:
        latencies: list[float] = []
        pids = _processes(self.group)
        busy = cpu_seconds(pids)
        first, began = self.statistics.steps, time.monotonic()
        now = began
        while limits.not_reached(self.statistics.steps - first, now - began):
            responses = _joined(await self._respond(self._everyone))
            sent_at = time.monotonic()
            batch, _ = await self.group.step(responses)
            now = time.monotonic()
            latencies.append(now - sent_at)
            self.statistics.add(batch)
        steps = self.statistics.steps - first
        used = max(0.0, cpu_seconds(pids) - busy)
        return as_round(steps, now - began, used, np.array(latencies))

    async def _collect(self, min_results: int, limits: Limits) -> Round:
        latencies: list[NDArray[np.float64]] = []
        group, sent_at = self.group, self._sent_at
        pids = _processes(self.group)
        busy = cpu_seconds(pids)
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
        steps, used = self.statistics.steps - first, max(0.0, cpu_seconds(pids) - busy)
        done = as_round(steps, now - began, used, np.concatenate(latencies))
        batch, _ = await group.collect_async(wait_all=True)
        self.statistics.add(batch)
        return done


def _processes(group: EnvGroup) -> list[int]:
    """Return the process ids of the trainer and of the group's workers."""
    pids = [worker["pid"] for worker in group.get_workers()]
    return [os.getpid(), *(pid for pid in pids if pid is not None)]


def as_round(
    steps: int, seconds: float, cpu_seconds: float, latencies: NDArray[np.float64]
) -> Round:
    """Return the figures of a measurement; latencies are given in seconds."""
    p50, p99 = np.percentile(latencies, [50, 99]) * 1e6
    return Round(steps / seconds, (float(p50), float(p99)), cpu_seconds / seconds)


def _joined(responses: list[BatchedData]) -> BatchedData:
    """Return one batch of all responses, for `step`."""
    if len(responses) == 1:
        return responses[0]
    values = [value for batch in responses for value in batch.values()]
    return BatchedData([value.env_id for value in values], values)


@contextlib.asynccontextmanager
async def opened_group(
    setting: Setting, policy: Policy | None = None, seed: int = 0
) -> AsyncGenerator[Stand]:
    """Build a group, and reset its envs.

    Raises:
        RLightningError: it could not start.
    """
    before = memory_bytes([os.getpid()])
    began = time.monotonic()
    async with rlightning_aio.build_env_group(list(setting.configs), mixed_actions=True) as group:
        roster = Roster(group)
        started = time.monotonic()
        everyone, _ = await group.reset(seed=seed)
        reset = time.monotonic()
        grown = max(0, memory_bytes([os.getpid()]) - before)
        workers = memory_bytes(_processes(group)[1:])
        costs = Costs(started - began, reset - started, workers or grown)
        with ensure_auto_reset(group):
            yield Stand(group, setting, roster, everyone, costs, policy, seed)


async def take_turn(stands: Stands, contender: Contender, limits: Limits) -> None:
    """Measure a contender once, or note why that is impossible.

    An error while it is measured takes the place of its stand.
    """
    stand = stands[contender.setting]
    if not isinstance(stand, RLightningError):
        contender.costs = stand.costs
        try:
            contender.rounds.append(await stand.measure(contender.rule, limits))
        except RLightningError as error:
            stand = stands[contender.setting] = error
    if isinstance(stand, RLightningError):
        contender.failure = in_words(stand).partition("\n")[0]


async def take_turns(
    stands: Stands,
    contenders: Sequence[Contender],
    rounds: int,
    limits: Limits,
    report: Callable[[Contender], None],
) -> None:
    """Measure all contenders in turn, `rounds` times; `report` is called after each.

    Raises:
        RLightningError: none could be measured.
    """
    for _, contender in in_turns(contenders, rounds):
        await take_turn(stands, contender, limits)
        report(contender)
        await asyncio.sleep(0)  # Let Ctrl-C take effect.
    if not any(contender.rounds for contender in contenders):
        raise_if_all_failed(stands)


def raise_if_all_failed(stands: Stands) -> None:
    """Raise the last error if there is no stand that works."""
    errors = [stand for stand in stands.values() if isinstance(stand, RLightningError)]
    if len(errors) == len(stands):
        raise errors[-1]
