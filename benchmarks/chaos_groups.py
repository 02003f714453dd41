"""Faults of every kind in several groups of one trainer: no hang, no false result, no leak?

    python benchmarks/chaos.py --groups 8 --faults 100000

Run by `chaos.py`. Based on the contract only: it uses the public interface of the library. Every
result identifies itself (see `witness`), so it can be compared with its request. Each request must
end exactly once (`chaos_books`). Leftovers are looked for after each group, and at the end. Groups
live for some hundred faults and are then replaced. A watchdog finds hangs: a thread that prints
all stacks, and an alarm that needs no Python.
"""

from __future__ import annotations

import asyncio
import contextlib
import faulthandler
import gc
import heapq
import itertools
import json
import logging
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import uuid
import warnings
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import uvloop
from chaos_books import LONGEST_WAIT, Books, Broken, Tally
from chaos_life import CLIENTS, HEARTBEAT, Awaited, Life
from chaos_processes import (
    held,
    process_state,
    processes_marked,
    processor_seconds,
    resources,
)
from harness import machine_facts, machine_text
from witness import BUILD_FAULTS

import rlightning_aio as rl
import rlightning_aio.sync
from rlightning_aio.errors import StartFailed

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

STEP_TIMEOUT = 1.0
"""Seconds; long enough for a worker that merely waits for its turn on a busy machine."""
START_TIMEOUT = 20.0
LONGEST_END = 10.0
"""Seconds within which the resources of a closed group must be released."""
ALLOWED_MIB = 48.0
"""Allowed growth of memory after the first quarter, for the allocator."""
SECONDS_BETWEEN_SAMPLES = 15.0
LOOPS = ("asyncio", "uvloop", "sync", "asyncio")
"""The driver of group k; groups on asyncio share a loop, and so do those on uvloop."""


def run_without_loop(coroutine: Coroutine[Any, Any, None]) -> None:
    """Run a coroutine that never suspends."""
    with contextlib.suppress(StopIteration):
        coroutine.send(None)
        raise AssertionError("it suspended")


class Trainer:
    """Runs one group after the other, all with the same driver."""

    def __init__(self, chaos: Chaos, number: int) -> None:
        self.number = number
        self.waits = LOOPS[number % len(LOOPS)]
        self.tally = Tally()
        self.last_beat = time.monotonic()
        self.over = False
        self.books: Books | None = None
        self.take_fault = chaos.take_fault
        self.is_over = chaos.is_over
        self.after = chaos.after
        self.command_keeper = chaos.command_keeper
        self._chaos = chaos
        self._rng = random.Random(f"{chaos.seed} {number}")

    def beat(self) -> None:
        """Record progress, for the watchdog."""
        self.last_beat = time.monotonic()

    async def run(self) -> None:
        """Build groups, run them, and check their leftovers, until there were enough faults."""
        lives = 0
        try:
            while not self.is_over():
                lives += 1
                self.beat()
                await self._live(lives)
        except Broken as broken:
            self.tally.broken.append(f"group {self.number}, life {lives}: {broken}")
        except BaseException:  # noqa: BLE001  # Whatever it is, it should not have been.
            trace = traceback.format_exc()
            self.tally.broken.append(f"group {self.number}, life {lives}: {trace}")
        finally:
            self.over = True

    def _entries(self, mark: str, orders: str) -> list[dict[str, Any]]:
        rng = self._rng
        witness = {"backend": "witness", "task": "anything", "imports": ["witness"]}
        limits = {"step_timeout": STEP_TIMEOUT, "reset_timeout": STEP_TIMEOUT}
        common = {
            **witness,
            **limits,
            "start_timeout": START_TIMEOUT,
            "max_restarts": 10**6,
            "env_vars": {"CHAOS_GROUP": mark},
        }

        def entry(name: str, num_workers: int, layout: str, **fields: Any) -> dict[str, Any]:
            kwargs = {"orders": orders, "layout": layout}
            fields = {"name": name, "num_workers": num_workers, "env_kwargs": kwargs, **fields}
            return {**common, **fields}

        entries = [
            entry("pair", 6, "vector", envs_per_process=2),
            entry("solo", 2, "halves", envs_per_process=1),
            entry("text", 1, "text"),
        ]
        if rng.random() < 0.2:
            entries[1]["env_vars"] = {"CHAOS_GROUP": mark, "CHAOS_OTHER": "1"}
        if rng.random() < 0.5:
            here = {"name": "here", "placement": "inline", "num_workers": 2, "env_kwargs": {}}
            entries.append({**witness, **here})
        if rng.random() < 0.5:
            awaited = entry("awaited", 4, "vector", envs_per_process=2)
            entries.append(awaited | {"backend": "awaitable witness"})
        if self.waits != "sync":
            loop = {"name": "loop", "placement": "loop", "num_workers": 4, "env_kwargs": {}}
            loop |= {"backend": "awaitable witness", "max_restarts": 10**6}
            entries.append({**witness, **limits, **loop, "max_concurrency": rng.choice((2, 4))})
        if rng.random() < 0.4:
            entries.append(entry("brittle", 1, "vector", on_worker_death="raise"))
        if rng.random() < 0.5:
            kwargs = {"min_clients": CLIENTS, "heartbeat": HEARTBEAT}
            far = {"name": "far", "backend": "env_server", "env_kwargs": kwargs}
            entries.append({**far, **limits})
        return entries

    async def _live(self, number: int) -> None:
        mark = f"{self._chaos.mark}-{self.number}-{number}"
        path = self._chaos.folder / f"orders-{self.number}"
        orders = np.memmap(path, np.uint8, "w+", shape=16)
        entries = self._entries(mark, str(path))
        zero_copy = self._rng.random() < 0.3
        build = rl.sync.build_env_group if self.waits == "sync" else rl.build_env_group
        group: Any = build(entries, zero_copy=zero_copy)
        if self.waits == "sync":
            group = Awaited(group)
        fate = self._rng.random()
        try:
            if fate < 0.04:
                await self._fail_to_start(group, orders)
            elif fate < 0.08 and self.waits != "sync":
                await self._cancel_start(group)
            else:
                await group.init()
                life = self._new_life(number, group, entries, orders, zero_copy=zero_copy)
                await life.run(self._rng.randint(*self._chaos.quota))
        finally:
            self.books = None
            await group.close()
        del group
        await self._check_that_nothing_is_left(mark)

    def _new_life(
        self,
        number: int,
        group: Any,
        entries: list[dict[str, Any]],
        orders: Any,
        *,
        zero_copy: bool,
    ) -> Life:
        rng = random.Random(f"{self._chaos.seed} {self.number} {number}")
        has_server = entries[-1]["backend"] == "env_server"
        names = [f"c{10 * self.number + k}" for k in range(CLIENTS)] if has_server else []
        self.books = Books(entries, names, self.tally, rng, waits=self.waits, zero_copy=zero_copy)
        return Life(group, self, self.books, orders, names, self.tally, rng, waits=self.waits)

    async def _fail_to_start(self, group: Any, orders: Any) -> None:
        fault = self._rng.choice((1, 2))
        orders[self._rng.randrange(6)] = fault
        self.tally.lives["failed to start"] += 1
        if self.take_fault():
            self.tally.faults[f"{BUILD_FAULTS[fault]} (in the first build)"] += 1
        try:
            await group.init()
        except StartFailed:
            return
        raise Broken("a group started whose env can't be built")

    async def _cancel_start(self, group: Any) -> None:
        self.tally.interrupted["init cancelled"] += 1
        self.tally.lives["given up at its start"] += 1
        task = asyncio.ensure_future(group.init())
        await asyncio.sleep(self._rng.uniform(0.0, 0.8))
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task

    async def _check_that_nothing_is_left(self, mark: str) -> None:
        """Check that the group's resources are released soon after its close."""
        until = time.monotonic() + LONGEST_END
        while left := processes_marked(f"CHAOS_GROUP={mark}\0"):
            if time.monotonic() > until:
                told = [process_state(pid) for pid in left]
                for pid in left:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
                raise Broken(f"a closed group has left {told}")
            if self.waits == "sync":
                time.sleep(0.05)  # noqa: ASYNC251  # Its thread is its own.
            else:
                await asyncio.sleep(0.05)


class Chaos:
    """All groups, the keepers of clients and of time, and the watchdog."""

    def __init__(self, groups: int, faults: int, seed: int, folder: Path, log: Any) -> None:
        self.seed = seed
        self.folder = folder
        self.mark = uuid.uuid4().hex
        self.quota = (300, 1500) if faults > 2000 else (40, 120)
        self.samples: list[dict[str, float]] = []
        self._faults = faults
        self._done = 0
        self._log = log
        self._lock = threading.Lock()
        self._keeper: subprocess.Popen[bytes] | None = None
        self._loops: list[asyncio.AbstractEventLoop] = []
        self._began = time.monotonic()
        self._strays: list[str] = []
        self._told: set[str] = set()
        self._later: list[tuple[float, int, Callable[[], object]]] = []
        self._count = itertools.count()
        self._sooner = threading.Condition()
        self._trainers = [Trainer(self, k) for k in range(groups)]

    def take_fault(self) -> bool:
        """Count another fault; return False if there were enough."""
        with self._lock:
            if self._done >= self._faults:
                return False
            self._done += 1
            return True

    def is_over(self) -> bool:
        """Return True if there were enough faults."""
        return self._done >= self._faults

    def after(self, seconds: float, doing: Callable[[], object]) -> None:
        """Call a function later, whatever waits meanwhile."""
        with self._sooner:
            heapq.heappush(self._later, (time.monotonic() + seconds, next(self._count), doing))
            self._sooner.notify()

    def _keep_time(self) -> None:
        """Call due functions, in a separate thread, until nothing more is expected."""
        while True:
            with self._sooner:
                if not self._later and all(trainer.over for trainer in self._trainers):
                    return
                due = self._later[0][0] if self._later else time.monotonic() + 0.5
                if due > time.monotonic() or not self._later:
                    self._sooner.wait(max(0.0, due - time.monotonic()))
                    continue
                doing = heapq.heappop(self._later)[2]
            doing()

    def command_keeper(self, order: str) -> None:
        """Send a command to the keeper of clients."""
        with self._lock:
            assert self._keeper is not None
            assert self._keeper.stdin is not None
            self._keeper.stdin.write(order.encode() + b"\n")
            self._keeper.stdin.flush()

    def run(self) -> None:
        """Run until the faults are done and everything is closed."""
        keeper = Path(__file__).with_name("client_keeper.py")
        env = {**os.environ, "CHAOS": self.mark}
        with subprocess.Popen(
            [sys.executable, str(keeper)], stdin=subprocess.PIPE, env=env
        ) as self._keeper:
            threads = [
                threading.Thread(target=self._keep_time),
                threading.Thread(target=self._run_loop, args=(asyncio.new_event_loop, "asyncio")),
                threading.Thread(target=self._run_loop, args=(uvloop.new_event_loop, "uvloop")),
            ]
            for trainer in self._trainers:
                if trainer.waits == "sync":
                    run = trainer.run()
                    threads.append(threading.Thread(target=run_without_loop, args=(run,)))
            for thread in threads:
                thread.start()
            self._watch(threads)

    def _run_loop(self, factory: Callable[[], Any], waits: str) -> None:
        mine = [trainer for trainer in self._trainers if trainer.waits == waits]
        with asyncio.Runner(loop_factory=factory) as runner:
            loop = runner.get_loop()
            loop.set_exception_handler(self._on_loop_error)
            self._loops.append(loop)

            async def together() -> None:
                await asyncio.gather(*(trainer.run() for trainer in mine))
                left = asyncio.all_tasks() - {asyncio.current_task()}
                if left:  # Envs that ignored their cancellation end some time later.
                    _, left = await asyncio.wait(left, timeout=LONGEST_END)
                self._strays += [f"task left: {task}" for task in left]

            runner.run(together())
            self._loops.remove(loop)

    def _on_loop_error(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        del loop
        error = context.get("exception")
        trace = "" if error is None else "".join(traceback.format_exception(error))
        self._strays.append(f"an event loop says: {context} {trace}")

    def tally(self) -> Tally:
        """Return the numbers of events so far."""
        tally = Tally(broken=list(self._strays))
        for trainer in self._trainers:
            tally.add(trainer.tally)
        return tally

    def _watch(self, threads: list[threading.Thread]) -> None:
        """Print the progress; if a group does nothing for too long, print stacks and exit."""
        told = time.monotonic()
        while any(thread.is_alive() for thread in threads):
            faulthandler.dump_traceback_later(2 * LONGEST_WAIT, exit=True, file=self._log)
            now = time.monotonic()
            for trainer in self._trainers:
                if not trainer.over and now - trainer.last_beat > LONGEST_WAIT:
                    self._dump(trainer)
                    os._exit(2)
            if now - told >= SECONDS_BETWEEN_SAMPLES:
                told = now
                self._sample(now)
            time.sleep(0.1)
        faulthandler.cancel_dump_traceback_later()
        self._sample(time.monotonic())

    def _sample(self, now: float) -> None:
        found = {"seconds": now - self._began, "faults": self._done, **resources()}
        self.samples.append(found)
        broken = self.tally().broken
        text = ", ".join(f"{name} {value:.0f}" for name, value in found.items())
        print(f"{text}, broken {len(broken)}", file=self._log, flush=True)
        for one in broken:
            if one not in self._told:
                self._told.add(one)
                print(f"broken: {one}", file=self._log, flush=True)

    def _dump(self, trainer: Trainer) -> None:
        log = self._log
        print(f"\ngroup {trainer.number} ({trainer.waits}) hangs", file=log)
        for env in [] if trainer.books is None else trainer.books.envs.values():
            print(f"  {env}", file=log)
        for pid in processes_marked(self.mark):
            print(f"  {process_state(pid)}", file=log)
        for loop in list(self._loops):
            for task in asyncio.all_tasks(loop):
                task.print_stack(file=log)
        for broken in self.tally().broken:
            print(f"broken: {broken}", file=log)
        log.flush()
        faulthandler.dump_traceback(log, all_threads=True)


def warm_up() -> None:
    """Run the first loops, which open descriptors that are kept."""

    async def nothing() -> None: ...

    for factory in (asyncio.new_event_loop, uvloop.new_event_loop):
        with asyncio.Runner(loop_factory=factory) as runner:
            runner.run(nothing())


def silence() -> tuple[Any, Any]:
    """Discard the megabytes of output of envs; return the original stdout and stderr."""
    streams = [os.fdopen(os.dup(k), "w", errors="backslashreplace") for k in (1, 2)]
    null = os.open(os.devnull, os.O_WRONLY)
    for descriptor in (1, 2):
        os.dup2(null, descriptor)
    os.close(null)
    warnings.simplefilter("ignore")
    logging.getLogger("rlightning_aio").propagate = False
    logging.getLogger("rlightning_aio").addHandler(logging.NullHandler())
    return streams[0], streams[1]


def hear_unraisable() -> list[str]:
    """Record exceptions that can't be caught, from now on."""
    heard: list[str] = []
    sys.unraisablehook = lambda found: heard.append(
        f"unraisable: {found.err_msg} {found.object!r}: {found.exc_value!r}"
    )
    threading.excepthook = lambda found: heard.append(
        f"in a thread: {found.thread}: {found.exc_type}: {found.exc_value!r}"
    )
    return heard


def growth(samples: list[dict[str, float]]) -> float:
    """Return the growth of memory in MiB since the first quarter of the faults."""
    last = samples[-1]
    first = next(found for found in samples if found["faults"] >= last["faults"] / 4)
    return last["rss_mib"] - first["rss_mib"]


def table(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    requests, ends = sum(report["requests"].values()), sum(report["ends"].values())
    rows = {
        f"{sum(report['faults'].values()):,} faults": _counts(report["faults"]),
        f"{requests:,} requests": _counts(report["requests"]),
        f"{ends:,} ends": _counts(report["ends"]),
        "results, by how they were waited for": _counts(report["drivers"]),
        "given up on purpose": _counts(report["interrupted"]),
        "misuse refused": _counts(report["refused"]),
        f"{sum(report['lives'].values()):,} groups": _counts(report["lives"]),
        "restarts that no fault asked for": f"{report['unasked']:,}",
        "processor time": f"{report['processor_seconds']:,.0f} s",
        "longest that a request took": f"{report['longest_wait']:.1f} s",
        "requests that never ended, or more than once": f"{abs(requests - ends):,}",
        "broken promises": f"{len(report['broken']):,}",
        "processes, descriptors, memory, threads, tasks left": f"{len(report['leaks']):,}",
        "memory since the first quarter": f"{report['grown_mib']:+.1f} MiB",
    }
    lines = [f"| {report['groups']} groups at once, {report['seconds']:,.0f} s | |", "|---|---|"]
    lines += [f"| {name} | {found} |" for name, found in rows.items()]
    return "\n".join([*lines, "", machine_text(report["machine"])])


def _counts(found: dict[str, int]) -> str:
    listed = sorted(found.items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{count:,} {name}" for name, count in listed) or "none"


def run(groups: int, faults: int, seed: int, log: Any) -> dict[str, Any]:
    """Run it; what is told of it."""
    warm_up()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        chaos = Chaos(groups, faults, seed, Path(folder), log)
        os.environ["CHAOS"] = chaos.mark
        unraisable = hear_unraisable()
        before = held()
        chaos.run()
        gc.collect()
        left = held() - before
        until = time.monotonic() + LONGEST_END
        while (others := processes_marked(f"CHAOS={chaos.mark}\0")) and time.monotonic() < until:
            time.sleep(0.1)
        left |= {process_state(pid) for pid in others}
    tally = chaos.tally()
    counters = {name: dict(v) for name, v in vars(tally).items() if isinstance(v, Counter)}
    return {
        "groups": groups,
        "seconds": time.monotonic() - began,
        "processor_seconds": processor_seconds(),
        **counters,
        "unasked": tally.unasked,
        "longest_wait": tally.longest_wait,
        "samples": chaos.samples,
        "grown_mib": growth(chaos.samples),
        "leaks": sorted(left),
        "broken": [*tally.broken, *unraisable],
        "machine": machine_facts([]),
    }


def main(groups: int, faults: int, seed: int, json_path: Path | None) -> int:
    """Parse arguments, run, and print; return 0 if all promises were kept."""
    out, log = silence()
    faulthandler.enable(log)
    report = run(groups, faults, seed, log)
    print(table(report), file=out)
    for broken in [*report["broken"], *report["leaks"]]:
        print(f"broken: {broken}", file=out)
    out.flush()
    if json_path is not None:
        json_path.write_text(json.dumps(report, indent=1) + "\n")
    requests, ends = sum(report["requests"].values()), sum(report["ends"].values())
    kept = requests == ends and not report["broken"] and not report["leaks"]
    return 0 if kept and report["grown_mib"] <= ALLOWED_MIB else 1
