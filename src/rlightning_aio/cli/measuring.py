"""Speed and latency of a group under several rules for when results are collected.

Rule: all envs are idle between measurements. Actions are random, and respond to the newest result
of each env, whose action mask they obey. Finished episodes are reset.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

import rlightning_aio
from rlightning_aio._core.group.api.facade import ensure_auto_reset
from rlightning_aio.batch import BatchedData
from rlightning_aio.batch.data import parts_of
from rlightning_aio.cli.measurement import Figures
from rlightning_aio.cli.policies import Responder, respond_to_all, steps_in

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
    from contextlib import AbstractAsyncContextManager

    from numpy.typing import NDArray

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.config import EnvConfig


@dataclass(frozen=True)
class Rule:
    """A rule for when results are collected.

    Attributes:
        words: its name in tables.
        min_results: the argument of `collect_async`; None for a synchronous `step` of all envs.
    """

    words: str
    min_results: int | None

    @property
    def call(self) -> str:
        """The call of a program that does it."""
        least = self.min_results
        return "step(batch)" if least is None else f"collect_async(min_results={least})"


@dataclass(frozen=True)
class Round:
    """One measurement.

    Attributes:
        latency_us: time from sending an action to receiving its result, p50 and p99.
        restarts: number of workers that were replaced meanwhile.
    """

    steps_per_second: float
    latency_us: tuple[float, float]
    restarts: int = 0


Measure: TypeAlias = "Callable[[Rule, float], Awaitable[Round]]"
"""Measures for some seconds, after a few steps that warm the caches."""


class Place:
    """A way to place and step envs.

    Attributes:
        words: its name in tables.
    """

    words: str

    def as_json(self) -> dict[str, Any]:
        """Return its description for JSON."""
        raise NotImplementedError

    def opened(self, seed: int | None) -> AbstractAsyncContextManager[Measure]:
        """Build and reset its envs, and return what measures them.

        Raises what building them raises.
        """
        raise NotImplementedError


@dataclass
class Contender:
    """A place with a rule, and its measurements."""

    place: Place
    rule: Rule
    rounds: list[Round] = field(default_factory=list[Round])
    failure: str | None = None

    @property
    def words(self) -> str:
        """Return its name in messages."""
        return f"{self.place.words}, {self.rule.words}"

    @property
    def rates(self) -> Figures:
        """Return the steps per second of the rounds."""
        return Figures([r.steps_per_second for r in self.rounds])

    @property
    def latency_us(self) -> tuple[float, float]:
        """Return the medians of the rounds' p50 and p99."""
        p50, p99 = (Figures([r.latency_us[k] for r in self.rounds]).median for k in (0, 1))
        return p50, p99

    @property
    def restarts(self) -> int:
        """Return the number of workers that were replaced in all rounds."""
        return sum(r.restarts for r in self.rounds)

    def as_json(self) -> dict[str, Any]:
        """Return all figures for JSON."""
        document: dict[str, Any] = {
            "place": self.place.words,
            **self.place.as_json(),
            "rule": self.rule.words,
            "min_results": self.rule.min_results,
            "failure": self.failure,
            "restarts": self.restarts,
            "rounds": self.rates.values,
        }
        if self.rounds:
            p50, p99 = self.latency_us
            document |= {
                "steps_per_second": self.rates.median,
                "spread": self.rates.spread,
                "latency_us": {"p50": p50, "p99": p99},
            }
        return document


class _OpenGroup:
    """An open group.

    Args:
        group: an initialised group that resets its envs at their ends.
        latest: the newest results of all its envs.
        seed: of the random actions.
    """

    def __init__(self, group: EnvGroup, latest: BatchedData, seed: int | None) -> None:
        self._group, self._latest = group, latest
        self._respond = Responder(group, None, seed)
        self._sent_at = np.zeros(len(latest))

    async def measure(self, rule: Rule, seconds: float) -> Round:
        """Collect by a rule for `seconds`, after a tenth that does not count."""
        least, before = rule.min_results, self._restarts()
        one_round = self._step if least is None else partial(self._collect, least)
        await one_round(seconds / 10)
        measured = await one_round(seconds)
        return replace(measured, restarts=self._restarts() - before)

    def _restarts(self) -> int:
        return int(self._group.metrics()["envs/restarts"])

    async def _step(self, seconds: float) -> Round:
        latencies, steps = list[float](), 0
        began = now = time.monotonic()
        while not steps or now - began < seconds:
            responses = _joined(await self._respond(self._latest))
            sent_at = time.monotonic()
            self._latest, _ = await self._group.step(responses)
            now = time.monotonic()
            latencies.append(now - sent_at)
            steps += steps_in(self._latest)
        return as_round(steps, now - began, np.array(latencies))

    async def _collect(self, min_results: int, seconds: float) -> Round:
        latencies, steps = list["NDArray[np.float64]"](), 0
        group, sent_at = self._group, self._sent_at
        sent_at[:] = began = now = time.monotonic()
        await respond_to_all(group, self._respond, self._latest)
        while not steps or now - began < seconds:
            batch, _ = await group.collect_async(min_results=min_results)
            now = time.monotonic()
            steps += steps_in(batch)
            for part in parts_of(batch):
                latencies.append(now - sent_at[part.slots])
                sent_at[part.slots] = now
            await respond_to_all(group, self._respond, batch)
        self._latest, _ = await group.collect_async(wait_all=True)
        return as_round(steps, now - began, np.concatenate(latencies))


def as_round(steps: int, seconds: float, latencies: NDArray[np.float64]) -> Round:
    """Return the figures of a measurement; latencies are given in seconds."""
    p50, p99 = np.percentile(latencies, [50, 99]) * 1e6
    return Round(steps / seconds, (float(p50), float(p99)))


def _joined(responses: list[BatchedData]) -> BatchedData:
    """Return one batch of all responses, for `step`."""
    if len(responses) == 1:
        return responses[0]
    values = [value for batch in responses for value in batch.values()]
    return BatchedData([value.env_id for value in values], values)


@contextlib.asynccontextmanager
async def opened_group(configs: Sequence[EnvConfig], seed: int | None) -> AsyncGenerator[Measure]:
    """Build a group, and reset its envs.

    Raises:
        RLightningError: it could not start.
    """
    async with rlightning_aio.build_env_group(list(configs), mixed_actions=True) as group:
        latest, _ = await group.reset(seed=seed)
        with ensure_auto_reset(group):
            yield _OpenGroup(group, latest, seed).measure
