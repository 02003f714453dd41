"""8 envs with different step times: how late do collects return?

`collect_async(min_results=k)` should return when the k-th result is ready, however long other envs
take and in whichever workers they live. Lateness is the time from then (or from the call, if that
many were ready before) to its return. The envs themselves report when a result is ready: an
observation is the time at which its step was done. The k-th result is the k-th of all that were
outstanding or left over, not of those that were handed out.

For each mixture of step times, bare processes, one for each worker but no more than there are
cores, also report times through a pipe: their lateness is the machine's own part. Env steps per
second at even step times are measured, too, because this must not cost speed.
"""

from __future__ import annotations

import json
import math
import multiprocessing as mp
import os
import time
from dataclasses import dataclass, field
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import no_work
import numpy as np
from contenders import Limit, OursAsync, OursSync, Work
from harness import (
    Contender,
    Load,
    Question,
    arguments,
    machine_facts,
    machine_text,
    measure,
    modules_of,
    number_text,
    take_turns,
)
from harness import tables as rate_tables

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

NUM_ENVS = 8
# One, a half, and all but the slow ones if two are slow.
LEAST = (1, 4, 6)
SLOW = 0.1
CALM = 256
CALM_STEP = 50e-6
ALLOWED_MS = 1.0
TITLE = f"Lateness of collects, {NUM_ENVS} envs of unlike step times"
DRIVERS = ("asyncio", "blocking")
PIPE = "bare pipe"

WORKS, SLEEPS = 0, 1


@dataclass(frozen=True)
class Mixture:
    """Step times, and the distribution of envs over workers.

    Attributes:
        times: ``[steps, envs, 2]``, repeated: seconds of work and of sleep.
        busy: its workers hardly ever sleep.
        rare: all envs are stepped again when all are done, not each when it was collected,
            and before each such turn come `CALM` others of `CALM_STEP`, which aren't counted.
    """

    name: str
    times: NDArray[np.float64]
    envs_per_worker: int
    busy: bool = False
    rare: bool = False

    @property
    def workers(self) -> int:
        return NUM_ENVS // self.envs_per_worker


def even(kind: int, seconds: float) -> NDArray[np.float64]:
    times = np.zeros((1, NUM_ENVS, 2))
    times[:, :, kind] = seconds
    return times


def log_normal(median: float, sigma: float, steps: int = 64) -> NDArray[np.float64]:
    """Return quantiles of the distribution, in a different order for each env."""
    normal = NormalDist(math.log(median), sigma)
    quantiles = np.exp([normal.inv_cdf((k + 0.5) / steps) for k in range(steps)])
    rng = np.random.default_rng(0)
    times = np.zeros((steps, NUM_ENVS, 2))
    times[:, :, SLEEPS] = np.stack([rng.permutation(quantiles) for _ in range(NUM_ENVS)], axis=1)
    return times


def slow_are(*turns: tuple[int, int], others: float = 0.0) -> NDArray[np.float64]:
    """Return times in which these envs sleep long, in turns; the others work for some seconds."""
    times = np.repeat(even(WORKS, others), len(turns), axis=0)
    for turn, envs in zip(times, turns, strict=True):
        turn[list(envs)] = 0.0, SLOW
    return times


MIXTURES = (
    Mixture("all work 20 µs, 4 to a worker", even(WORKS, 20e-6), 4, busy=True),
    Mixture("all work 20 µs, 1 to a worker", even(WORKS, 20e-6), 1, busy=True),
    Mixture("all work 1 ms, 4 to a worker", even(WORKS, 1e-3), 4, busy=True),
    Mixture("all work 1 ms, 1 to a worker", even(WORKS, 1e-3), 1, busy=True),
    Mixture("log-normal sleeps, 4 to a worker", log_normal(2e-3, 1.5), 4),
    Mixture("log-normal sleeps, 1 to a worker", log_normal(2e-3, 1.5), 1),
    # The third, then the last of each worker: exactly four are done before a slow one, then six.
    Mixture(
        "all work 50 µs, 2 of 8 rarely take 100 ms, 4 to a worker",
        slow_are((2, 6), (3, 7), others=CALM_STEP),
        4,
        rare=True,
    ),
    Mixture("the same 2 of 8 take 100 ms, 4 to a worker", slow_are((2, 3)), 4, busy=True),
    Mixture("the same 2 of 8 take 100 ms, 1 to a worker", slow_are((2, 3)), 1, busy=True),
)


# ---- collects


class Calls:
    """The collects in order, with the outstanding requests of each."""

    def __init__(self) -> None:
        self._called: list[float] = []
        self._returned: list[float] = []
        self._wanted: list[int] = []
        # By env, the first collect during which its request is outstanding.
        self._first = [0] * NUM_ENVS
        # For each result its env, that first collect, the one that returned it, and the time when
        # it was done.
        self._results: list[tuple[int, int, int, float]] = []

    def __len__(self) -> int:
        return len(self._called)

    def sent(self, envs: Sequence[int]) -> None:
        for env in envs:
            self._first[env] = len(self)

    def collect(self, wanted: int) -> Generator[int, Any, Any]:
        """Yield `wanted` and be sent the batch."""
        called = time.monotonic()
        batch = yield wanted
        self._returned.append(time.monotonic())
        self._called.append(called)
        self._wanted.append(wanted)
        return batch

    def came(self, envs: Sequence[int], done: Sequence[float]) -> None:
        """Record the results of the last collect."""
        for env, when in zip(envs, done, strict=True):
            self._results.append((env, self._first[env], len(self) - 1, when))

    def late_ms(self) -> list[float]:
        """Return the lateness of each collect; all results must have come."""
        done = np.full((len(self), NUM_ENVS), np.inf)
        for env, first, last, when in self._results:
            done[first : last + 1, env] = when
        ready = np.sort(done, axis=1)[np.arange(len(self)), np.array(self._wanted) - 1]
        return (1e3 * (np.array(self._returned) - np.maximum(self._called, ready))).tolist()


class Collector:
    """Steps a group through a mixture; its caller waits."""

    def __init__(self, group: Any, everyone: Any, mixture: Mixture) -> None:
        self._group = group
        self._everyone = everyone
        self._mixture = mixture
        self._numbers = {env_id: k for k, env_id in enumerate(everyone.ids())}
        self._steps = np.zeros(NUM_ENVS, np.intp)

    def collects(self, least: int, seconds: float) -> Generator[int, Any, list[float]]:
        """Yield the `min_results` of each collect and get its batch; return the latenesses.

        Nothing is outstanding afterwards.
        """
        calls = Calls()
        calm = even(WORKS, CALM_STEP)[0]
        until = time.monotonic() + seconds
        while not calls or time.monotonic() < until:
            if self._mixture.rare:
                for _ in range(CALM):
                    self._group.step_async(self._everyone.respond(action=calm))
                    yield from self._bring(NUM_ENVS, least, Calls())
                self._send(self._everyone, calls)
                yield from self._bring(NUM_ENVS, least, calls)
            else:
                yield from self._stream(least, until, calls)
        return calls.late_ms()

    def _bring(self, outstanding: int, least: int, calls: Calls) -> Generator[int, Any, None]:
        """Collect until nothing is outstanding."""
        while outstanding:
            batch = yield from calls.collect(min(least, outstanding))
            self._note(batch, calls)
            outstanding -= len(batch)

    def _stream(self, least: int, until: float, calls: Calls) -> Generator[int, Any, None]:
        """Step each env again when it was collected; at the end, wait for all."""
        batch = self._everyone
        while not calls or time.monotonic() < until:
            self._send(batch, calls)
            batch = yield from calls.collect(least)
            self._note(batch, calls)
        yield from self._bring(NUM_ENVS - len(batch), least, calls)

    def _note(self, batch: Any, calls: Calls) -> None:
        calls.came(self._envs_of(batch), batch.observation[:, 0].tolist())

    def _send(self, batch: Any, calls: Calls) -> None:
        envs = self._envs_of(batch)
        times = self._mixture.times
        self._group.step_async(batch.respond(action=times[self._steps[envs] % len(times), envs]))
        self._steps[envs] += 1
        calls.sent(envs)

    def _envs_of(self, batch: Any) -> list[int]:
        return [self._numbers[env_id] for env_id in batch.ids()]


@dataclass
class Asyncio(OursAsync):
    """A round measures the latenesses for each of `LEAST`."""

    mixture: Mixture = field(kw_only=True)

    def begin(self) -> None:
        self._collector = Collector(self._envs, self._first, self.mixture)

    def round(self, seconds: float) -> Any:
        return {k: self._runner.run(self._late_ms(k, seconds / len(LEAST))) for k in LEAST}

    async def _late_ms(self, least: int, seconds: float) -> list[float]:
        collects = self._collector.collects(least, seconds)
        batch = None
        while True:
            try:
                wanted = collects.send(batch)
            except StopIteration as stop:
                return stop.value
            batch, _ = await self._envs.collect_async(min_results=wanted)


@dataclass
class Blocking(OursSync):
    """A round measures the latenesses for each of `LEAST`."""

    mixture: Mixture = field(kw_only=True)

    def setup(self) -> None:
        super().setup()
        self._collector = Collector(self._envs, self._batch, self.mixture)

    def round(self, seconds: float) -> Any:
        return {k: self._late_ms(k, seconds / len(LEAST)) for k in LEAST}

    def _late_ms(self, least: int, seconds: float) -> list[float]:
        collects = self._collector.collects(least, seconds)
        batch = None
        while True:
            try:
                wanted = collects.send(batch)
            except StopIteration as stop:
                return stop.value
            batch, _ = self._envs.collect_async(min_results=wanted)


@dataclass
class BarePipe(Contender):
    """Processes report times through one pipe, each after a millisecond of work or sleep.

    There are as many as workers in the mixture, but no more than cores. A round measures how late
    each report was read.
    """

    name: str
    mixture: Mixture

    def round(self, seconds: float) -> Any:
        reading, writing = os.pipe()
        context = mp.get_context("fork")
        processes = [
            context.Process(target=self._report, args=(writing, seconds / len(LEAST)))
            for _ in range(min(self.mixture.workers, len(os.sched_getaffinity(0))))
        ]
        for process in processes:
            process.start()
        os.close(writing)
        late_ms: list[float] = []
        while report := os.read(reading, 8):
            late_ms.append((time.monotonic_ns() - int.from_bytes(report)) / 1e6)
        os.close(reading)
        for process in processes:
            process.join()
        return late_ms

    def _report(self, writing: int, seconds: float) -> None:
        """Run in each of the processes."""
        wait = no_work.work if self.mixture.busy else time.sleep
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            wait(1e-3)
            os.write(writing, time.monotonic_ns().to_bytes(8))


def contenders(mixture: Mixture) -> list[Contender]:
    """Return both drivers and the bare pipe."""
    work = Work(no_work.SPENDS, NUM_ENVS, modules=("no_work",))
    ours = [
        kind(
            f"{driver}, {mixture.name}",
            work,
            envs_per_process=mixture.envs_per_worker,
            auto_reset=False,
            mixture=mixture,
        )
        for driver, kind in zip(DRIVERS, (Asyncio, Blocking), strict=True)
    ]
    return [*ours, BarePipe(f"{PIPE}, {mixture.name}", mixture)]


# ---- the rate at even step times


@dataclass
class BlockingHalf(OursSync):
    """`sync.EnvGroup`: the envs of the first half are stepped again."""

    def setup(self) -> None:
        super().setup()
        self._send(self._batch)

    def _send(self, batch: Any) -> None:
        self._envs.step_async(batch.respond(action=next(self._actions)[: len(batch)]))

    def step(self) -> int:
        batch, _ = self._envs.collect_async(min_results=self.work.num_envs // 2)
        _ = batch.observation, batch.reward
        self._send(batch)
        return len(batch)


def rate_contenders(task: str, name: str) -> list[Contender]:
    work = Work(task, 32, modules=("no_work",))
    half = work.num_envs // 2
    return [
        OursAsync(f"asyncio, 16 of 32, {name}", work, half, auto_reset=False, min_results=half),
        BlockingHalf(f"blocking, 16 of 32, {name}", work, half, auto_reset=False),
        Limit(f"2 bare loops, {name}", work, processes=2, num_envs=half),
    ]


RATES = Question(
    name="even",
    title="32 envs of even step times, 16 to a worker",
    unit="env steps/s",
    contenders=[
        *rate_contenders(no_work.WORKS_30_US, "30 µs of work"),
        *rate_contenders(no_work.WORKS_5_US, "5 µs of work"),
    ],
)


# ---- reports


def summary(late_ms: Sequence[float]) -> dict[str, float]:
    """Return statistics of latenesses; `p99` is one of them."""
    return {
        "count": len(late_ms),
        "median": float(np.median(late_ms)),
        "p99": float(np.quantile(late_ms, 0.99, method="higher")),
        "worst": max(late_ms),
    }


def _p99_text(brought: Any) -> str:
    """Format the values of a round, by `min_results` or all alike."""
    found = brought if isinstance(brought, dict) else {0: brought}
    return "p99 " + ", ".join(number_text(summary(late)["p99"]) for late in found.values()) + " ms"


def rows_of(mixture: Mixture, turns: dict[str, list[tuple[Any, Load]]]) -> list[dict[str, Any]]:
    """Return the report's rows of one mixture: one for each `min_results`, with what took part."""
    brought = {name: [value for value, _ in found] for name, found in turns.items()}
    pipe = brought.get(f"{PIPE}, {mixture.name}")
    machine = pipe and summary([late for values in pipe for late in values])
    drivers = {d: brought[name] for d in DRIVERS if (name := f"{d}, {mixture.name}") in brought}
    rows: list[dict[str, Any]] = []
    for least in LEAST:
        row: dict[str, Any] = {"mixture": mixture.name, "min_results": least, PIPE: machine}
        for driver, rounds in drivers.items():
            row[driver] = summary([late for values in rounds for late in values[least]])
        if machine and drivers:
            bound = row["bound"] = ALLOWED_MS + machine["p99"]
            row["met"] = all(row[driver]["p99"] <= bound for driver in drivers)
        rows.append(row)
    return rows


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """Return the rows as Markdown."""
    target = f"p99 ≤ {ALLOWED_MS:g} ms + the pipe's"
    lines = [
        f"| {TITLE}; median / p99 / worst, ms | k | asyncio | blocking | bare pipe | {target} |",
        "|---|---:|---:|---:|---:|---|",
    ]
    for row in rows:
        cells = " | ".join(_cell(row.get(name)) for name in (*DRIVERS, PIPE))
        met = {True: "met", False: "missed", None: ""}[row.get("met")]
        lines.append(f"| {row['mixture']} | {row['min_results']} | {cells} | {met} |")
    return "\n".join(lines)


def _cell(found: dict[str, float] | None) -> str:
    if not found:
        return ""
    return " / ".join(number_text(found[name]) for name in ("median", "p99", "worst"))


def plot(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Plot a line from median to p99 for each driver and the pipe, and a dot for the worst."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(9, 1 + 0.36 * len(rows)), layout="constrained")
    colors = dict(zip((*DRIVERS, PIPE), ("tab:blue", "tab:orange", "tab:gray"), strict=True))
    for shift, (name, color) in enumerate(colors.items()):
        found = [(k + 0.25 * (shift - 1), row[name]) for k, row in enumerate(rows) if row.get(name)]
        places = [place for place, _ in found]
        axes.hlines(
            places, [f["median"] for _, f in found], [f["p99"] for _, f in found],
            color=color, linewidth=3, label=name,
        )  # fmt: skip
        axes.plot([f["worst"] for _, f in found], places, ".", color=color, markersize=4)
    axes.set_yticks(
        range(len(rows)), [f"{row['mixture']}, k = {row['min_results']}" for row in rows]
    )
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("ms late: median to p99, and worst")
    axes.set_title(TITLE, fontsize=10, loc="left")
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(y=0.01)
    figure.legend(fontsize=8, loc="outside lower center", ncols=3)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def run(rounds: int, seconds: float, only: Sequence[str]) -> dict[str, Any]:
    """Answer both questions; return the report as plain data."""
    machine = machine_facts(modules_of(contenders(MIXTURES[0])))
    rows: list[dict[str, Any]] = []
    skipped: dict[str, str] = {}
    for mixture in MIXTURES:
        turns, left_out = take_turns(contenders(mixture), rounds, seconds, only, _p99_text)
        skipped |= left_out
        if turns:
            rows += rows_of(mixture, turns)
    rates = measure(RATES, rounds, seconds, only)
    shown = [tables(rows), *(f"{name}: {why}" for name, why in skipped.items())]
    if rates["results"] or rates["skipped"]:
        shown.append(rate_tables(rates))
    return {
        "name": "uneven",
        "title": TITLE,
        "rounds": rounds,
        "seconds": seconds,
        "machine": machine,
        "lateness": rows,
        "rates": rates["results"],
        "skipped": skipped | rates["skipped"],
        "tables": "\n\n".join(shown),
    }


def main() -> None:
    given = arguments(__doc__, rounds=3, seconds=1.5)
    report = run(given.rounds, given.seconds, given.only)
    print(f"{report['tables']}\n\n{machine_text(report['machine'])}")
    if given.json:
        given.json.write_text(json.dumps(report, indent=1) + "\n")
    if given.plot:
        plot(report["lateness"], given.plot)


if __name__ == "__main__":
    main()
