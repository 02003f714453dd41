"""A thousand random faults under load: does every request end once, with the right result?

    python benchmarks/chaos.py
    python benchmarks/chaos.py --faults 100 --seed 7 --json chaos.json
    python benchmarks/chaos.py --groups 8 --faults 100000

8 environments in 4 workers step as fast as they can while workers are killed, stopped and
continued, and while environments hang, raise and exit; meanwhile, collects are cancelled and cut
short. Results are compared with the requests. Exit code 1: a promise was broken. The time to notice
deaths is printed but not judged, because the machine may be busy. Hanging environments write their
stacks to stderr; ``2>/dev/null`` hides them.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import json
import logging
import os
import random
import re
import signal
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import chaos_groups
import numpy as np
from breakable import EPISODE, EXIT, HANG, INDEX, NOTHING, PID, RAISE, STEPS, TOKEN
from harness import machine_facts, machine_text, shared_memory

import rlightning_aio as rl
from rlightning_aio.errors import EnvFault, EnvRaised

if TYPE_CHECKING:
    from collections.abc import Coroutine, Iterable

    from rlightning_aio import EnvGroup

ENVS, WORKERS = 8, 4
SHARE = ENVS // WORKERS
STEP_TIMEOUT = 0.5
"""Seconds; long enough for a worker that merely waits for its turn on a busy machine."""
LONGEST_STOP = 0.1
LONGEST_WAIT = 60.0
"""Seconds after which a request counts as lost."""
TARGET = 0.1
"""Seconds within which 99 of 100 deaths should be noticed."""
FAULTS = ("killed", "stopped", "hung", "raised", "exited")
DEADLY = ("killed", "hung", "exited")
SENT = {"hung": HANG, "raised": RAISE, "exited": EXIT}
"""Faults that an action carries."""


class Broken(Exception):
    """A promise was broken."""


@dataclass
class Doom:
    """A deadly fault that the group hasn't reported yet: its kind and its time."""

    fault: str
    env: int
    since: float | None = None


@dataclass
class Findings:
    """The events of a run."""

    requests: Counter[str] = field(default_factory=Counter)
    ends: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    noticed: dict[str, list[float]] = field(default_factory=lambda: {f: [] for f in DEADLY})
    interrupted: Counter[str] = field(default_factory=Counter)
    unasked: int = 0
    broken: list[str] = field(default_factory=list)


class Deaths(logging.Handler):
    """Records when the group notices a death, from its log."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.heard: list[tuple[int, float]] = []
        self._logger = logging.getLogger("rlightning_aio")

    def __enter__(self) -> Self:
        self._logger.addHandler(self)
        self._logger.propagate = False
        return self

    def __exit__(self, *error: object) -> None:
        self._logger.removeHandler(self)
        self._logger.propagate = True

    def emit(self, record: logging.LogRecord) -> None:
        if found := re.search(r"env 'e-(\d+)'", record.getMessage()):
            self.heard.append((int(found[1]) // SHARE, time.monotonic()))


@dataclass
class Request:
    """A request to an environment that hasn't ended."""

    kind: str
    token: float = 0.0
    raises: bool = False


@dataclass
class Env:
    """What has been observed of an environment, and the requests that it owes."""

    pid: int = 0
    episode: int = 0
    steps: int = 0
    open: Request | None = None
    to_reset: bool = False


class Chaos:
    """One run.

    Args:
        group: initialised; its envs are called e-0, e-1, …
        clock: where envs write the time at which they begin to die or hang.
    """

    def __init__(
        self, group: EnvGroup, deaths: Deaths, clock: Any, faults: int, rng: random.Random
    ) -> None:
        self.findings = Findings()
        self._group = group
        self._deaths = deaths
        self._clock = clock
        self._rng = rng
        self._plan = [FAULTS[k % len(FAULTS)] for k in range(faults)]
        rng.shuffle(self._plan)
        self._envs = [Env() for _ in range(ENVS)]
        self._dooms: dict[int, Doom] = {}
        self._processes: dict[int, int] = {}
        self._pids: dict[int, int] = {}
        self._stopped: dict[int, asyncio.Task[None]] = {}
        self._resets: set[asyncio.Task[None]] = set()
        self._token = 0.0

    # -- the loop -----------------------------------------------------------------

    async def run(self) -> None:
        """Step until all faults have happened, and every request has ended."""
        try:
            await self._reset(range(ENVS))
            while self._plan or self._dooms or self._stopped:
                self._send()
                self._strike_from_outside()
                await self._collect()
                self._note_deaths()
            while any(env.open for env in self._envs):
                await self._collect()
            await self._check_that_all_are_usable()
        finally:
            for task in (*self._stopped.values(), *self._resets):
                task.cancel()
            await asyncio.gather(*self._stopped.values(), *self._resets, return_exceptions=True)
            for descriptor in self._processes.values():
                os.close(descriptor)

    def _send(self) -> None:
        """Step some of the idle envs; reset those that raised."""
        for k, env in enumerate(self._envs):
            if env.to_reset:
                env.to_reset = False
                task = asyncio.create_task(self._reset([k]))
                self._resets.add(task)
        idle = [k for k, env in enumerate(self._envs) if not env.open]
        chosen = [k for k in idle if self._rng.random() < 0.9] or idle
        if chosen:
            self._step(chosen)

    def _step(self, chosen: list[int]) -> None:
        responses = []
        for k in chosen:
            fault = self._fault_for(k)
            self._token += 1.0
            self._open(k, Request("step", self._token, raises=fault == RAISE))
            action = np.array([fault, self._token])
            responses.append(rl.PolicyResponse(f"e-{k}", action=action))
        self._group.step_async(rl.BatchedData([f"e-{k}" for k in chosen], responses))

    def _fault_for(self, env: int) -> int:
        """Return the fault for the next step of an env: mostly none."""
        worker = env // SHARE
        busy = worker in self._dooms or worker in self._stopped
        # An env that was replaced reports that first, whatever fault its step has.
        if busy or self._pids.get(worker) != self._envs[env].pid:
            return NOTHING
        if not self._due() or self._plan[-1] not in SENT:
            return NOTHING
        fault = self._next_fault()
        if fault in DEADLY:
            self._clock[env] = 0.0
            self._dooms[worker] = Doom(fault, env)
        return SENT[fault]

    def _strike_from_outside(self) -> None:
        if not self._due() or self._plan[-1] in SENT:
            return
        free = [w for w in self._processes if w not in self._dooms and w not in self._stopped]
        if not free:
            return
        worker, fault = self._rng.choice(free), self._next_fault()
        if fault == "killed":
            self._dooms[worker] = Doom(fault, worker * SHARE, time.monotonic())
            self._signal(worker, signal.SIGKILL)
        else:
            self._stopped[worker] = asyncio.create_task(self._stop(worker))

    async def _stop(self, worker: int) -> None:
        self._signal(worker, signal.SIGSTOP)
        try:
            await asyncio.sleep(self._rng.uniform(0.001, LONGEST_STOP))
        finally:
            self._signal(worker, signal.SIGCONT)
            del self._stopped[worker]

    def _signal(self, worker: int, number: int) -> None:
        # Gone already: the group found that it hung for too long.
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._processes[worker], number)

    def _due(self) -> bool:
        """Return True if a fault is due: at random, after a few peaceful collects on average."""
        return bool(self._plan) and self._rng.random() < 0.02

    def _next_fault(self) -> str:
        fault = self._plan.pop()
        self.findings.faults[fault] += 1
        return fault

    # -- answers ------------------------------------------------------------------

    async def _collect(self) -> None:
        """Collect in one of the possible ways; some calls are cancelled on purpose."""
        if not any(env.open and env.open.kind == "step" for env in self._envs):
            await asyncio.wait(self._resets, return_when=asyncio.FIRST_COMPLETED)
            self._reap()
            return
        rng = self._rng
        given_up = rng.choice(("cancelled", "past its deadline")) if rng.random() < 0.05 else None
        try:
            if given_up == "cancelled":
                batch, _ = await asyncio.wait_for(self._group.collect_async(), 0.0005)
            else:
                batch, _ = await self._group.collect_async(
                    timeout=0.001 if rng.random() < 0.1 else None,
                    min_results=rng.choice((1, 1, 2, 4)),
                    max_results=rng.choice((None, None, 5)),
                    deadline=0.0005 if given_up else LONGEST_WAIT,
                )
        except TimeoutError:
            if given_up is None:
                raise Broken(f"no answer within {LONGEST_WAIT} s: {self._owed()}") from None
            self.findings.interrupted[given_up] += 1
        except EnvFault as fault:
            self._failed(fault)
        else:
            self._take(batch)
        self._reap()

    def _reset(self, envs: Iterable[int]) -> Coroutine[Any, Any, None]:
        """Reset envs; the awaiting task waits for the results, while others collect."""
        for k in envs:
            self._open(k, Request("reset"))
        return self._await_reset(list(envs))

    async def _await_reset(self, envs: list[int]) -> None:
        async with asyncio.timeout(LONGEST_WAIT):
            batch, _ = await self._group.reset(env_ids=[f"e-{k}" for k in envs])
        self._take(batch)

    def _reap(self) -> None:
        for task in [task for task in self._resets if task.done()]:
            self._resets.discard(task)
            task.result()

    async def _check_that_all_are_usable(self) -> None:
        """Check that every env can be reset and stepped at the end."""
        await self._reset(range(ENVS))
        self._step(list(range(ENVS)))
        async with asyncio.timeout(LONGEST_WAIT):
            batch, _ = await self._group.collect_async(wait_all=True)
        self._take(batch)

    def _open(self, env: int, request: Request) -> None:
        assert self._envs[env].open is None
        self._envs[env].open = request
        self.findings.requests[request.kind] += 1

    def _close(self, env: int, how: str) -> Request:
        request, self._envs[env].open = self._envs[env].open, None
        self.findings.ends[how] += 1
        if request is None:
            raise Broken(f"e-{env} answered ({how}) although nothing was asked of it")
        return request

    def _take(self, batch: Any) -> None:
        for env_id, ret in batch.items():
            env = int(env_id.removeprefix("e-"))
            marked = "worker_restarted" in ret.info
            request = self._close(env, "marked result" if marked else "result")
            wrong = self._wrong(env, request, ret, marked=marked)
            if wrong:
                self.findings.broken.append(f"e-{env}, {request}: {wrong} in {ret}")

    def _wrong(self, k: int, request: Request, ret: Any, *, marked: bool) -> str | None:
        """Return what is wrong with the result of an env, or None."""
        env, seen = self._envs[k], ret.observation
        pid, episode, steps = int(seen[PID]), int(seen[EPISODE]), int(seen[STEPS])
        if ret.env_id != f"e-{k}" or seen[INDEX] != k:
            return "another env's data"
        replaced = pid != env.pid
        before, env.pid, env.episode, env.steps = (env.episode, env.steps), pid, episode, steps
        self._know(k // SHARE, pid)
        if marked:
            fresh = replaced and (episode, steps, seen[TOKEN]) == (1, 0, 0.0)
            alike = ret.last_truncated and not ret.last_terminated and ret.last_reward == 0.0
            return None if fresh and alike else "not the first reset of a new life"
        if ret.info != {"index": k, "steps": steps}:
            return "another step's info"
        if request.kind == "reset":
            expected = (1 if replaced else before[0] + 1, 0)
            return None if (episode, steps) == expected else f"not reset as {expected}"
        if replaced or (episode, steps) != (before[0], before[1] + 1):
            return f"not the step after {before}"
        if seen[TOKEN] != request.token or ret.last_reward != request.token:
            return "the answer to another request"
        return "a result where it should have raised" if request.raises else None

    def _failed(self, fault: EnvFault) -> None:
        """End the requests that a typed error names."""
        names = getattr(fault, "env_ids", None) or (fault.env_id,)
        for name in names:
            env = int(name.removeprefix("e-"))
            request = self._close(env, type(fault).__name__)
            if not (isinstance(fault, EnvRaised) and request.raises):
                self.findings.broken.append(f"e-{env}, {request}: unexpected {fault!r}")
            self._envs[env].to_reset = True

    def _owed(self) -> str:
        return ", ".join(f"e-{k} {env.open}" for k, env in enumerate(self._envs) if env.open)

    # -- deaths -------------------------------------------------------------------

    def _know(self, worker: int, pid: int) -> None:
        """Keep a descriptor of a worker's current process, because its number may be reused."""
        if self._pids.get(worker) == pid:
            return
        self._forget(worker)
        with suppress(ProcessLookupError):  # It has replied, and died since.
            self._processes[worker] = os.pidfd_open(pid)
            self._pids[worker] = pid

    def _forget(self, worker: int) -> None:
        if worker in self._pids:
            del self._pids[worker]
            os.close(self._processes.pop(worker))

    def _note_deaths(self) -> None:
        """Record the deaths that the group has reported, and the time it took to notice them."""
        for worker, when in self._deaths.heard:
            self._forget(worker)
            doom = self._dooms.pop(worker, None)
            if doom is None:
                self.findings.unasked += 1
                continue
            since = doom.since or float(self._clock[doom.env])
            if doom.fault == "hung":
                since += STEP_TIMEOUT
            self.findings.noticed[doom.fault].append(max(0.0, when - since))
        self._deaths.heard.clear()


def held() -> set[str]:
    """Return the child processes, descriptors and shared memory of this process."""
    children = {
        f"process {pid}"
        for path in Path("/proc/self/task").glob("*/children")
        for pid in path.read_text().split()
    }
    descriptors = set()
    for path in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):  # The descriptor of the listing itself.
            descriptors.add(f"descriptor {path.name}: {path.readlink()}")
    return children | descriptors | {f"shared memory {name}" for name in shared_memory()}


async def nothing() -> None:
    """Do nothing, in the first event loop, which opens descriptors that are kept."""


async def chaos(faults: int, seed: int, clock: str) -> Findings:
    """Run it; return the findings."""
    entry = {
        "name": "e",
        "backend": "breakable",
        "task": "anything",
        "num_workers": ENVS,
        "envs_per_process": SHARE,
        "env_kwargs": {"clock": clock},
        "imports": ["breakable"],
        "step_timeout": STEP_TIMEOUT,
        "reset_timeout": STEP_TIMEOUT,
        "max_restarts": 1000,
    }
    times = np.memmap(clock, np.float64, "w+", shape=ENVS)
    with Deaths() as deaths:
        async with rl.build_env_group(entry) as group:
            run = Chaos(group, deaths, times, faults, random.Random(seed))
            try:
                await run.run()
            except Broken as broken:
                run.findings.broken.append(str(broken))
    return run.findings


def report_of(findings: Findings, seconds: float, left: set[str]) -> dict[str, Any]:
    """Return the report of a run."""
    deaths = findings.noticed["killed"] + findings.noticed["exited"]
    return {
        "seconds": seconds,
        "faults": dict(findings.faults),
        "requests": dict(findings.requests),
        "ends": dict(findings.ends),
        "interrupted": dict(findings.interrupted),
        "unasked_restarts": findings.unasked,
        "noticed_ms": {
            name: {"count": len(times), **_percentiles(times)}
            for name, times in {**findings.noticed, "deaths": deaths}.items()
        },
        "target_ms": 1e3 * TARGET,
        "leaks": sorted(left),
        "broken": findings.broken,
        "machine": machine_facts([]),
    }


def _percentiles(times: list[float]) -> dict[str, float]:
    if not times:
        return {}
    p50, p99, most = np.percentile(times, (50, 99, 100)) * 1e3
    return {"p50": float(p50), "p99": float(p99), "max": float(most)}


def table(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    requests, ends = sum(report["requests"].values()), sum(report["ends"].values())
    listed = {
        f"{sum(report['faults'].values())} faults": _counts(report["faults"]),
        f"{requests} requests": _counts(report["requests"]),
        f"{ends} ends": _counts(report["ends"]),
        "collects given up on purpose": _counts(report["interrupted"]),
        "restarts that no fault asked for": str(report["unasked_restarts"]),
        "requests that never ended, or more than once": str(abs(requests - ends)),
        "broken promises": str(len(report["broken"])),
        "processes, descriptors, shared memory left": str(len(report["leaks"])),
    }
    lines = [f"| chaos, {report['seconds']:.0f} s | |", "|---|---|"]
    lines += [f"| {name} | {found} |" for name, found in listed.items()]
    lines += ["", "| from … until the group has noticed | n | p50 | p99 | max |"]
    lines += ["|---|---:|---:|---:|---:|"]
    for name, title in {
        "killed": "SIGKILL sent",
        "exited": "call of os._exit",
        "deaths": "both deaths",
        "hung": "end of step_timeout, stack dump included",
    }.items():
        found = report["noticed_ms"][name]
        shown = [f"{found[p]:.1f} ms" if p in found else "" for p in ("p50", "p99", "max")]
        lines.append(f"| {title} | {found['count']} | {' | '.join(shown)} |")
    p99 = report["noticed_ms"]["deaths"].get("p99", 0.0)
    verdict = "met" if p99 < report["target_ms"] else "missed"
    lines += ["", f"Target: p99 of both deaths below {report['target_ms']:.0f} ms: {verdict}."]
    lines += ["Noticed means told in the log; the replacement's start is not in it."]
    return "\n".join([*lines, "", machine_text(report["machine"])])


def _counts(found: dict[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in sorted(found.items())) or "none"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--faults", type=int, default=1000, help="default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="of the order of faults")
    parser.add_argument("--json", type=Path, help="also write the report to this file")
    parser.add_argument(
        "--groups", type=int, help="every kind of fault, against so many groups in one trainer"
    )
    arguments = parser.parse_args()
    if arguments.groups:
        return chaos_groups.main(arguments.groups, arguments.faults, arguments.seed, arguments.json)
    rl.run(nothing())
    before, began = held(), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        clock = str(Path(folder) / "clock")
        findings = rl.run(chaos(arguments.faults, arguments.seed, clock))
    gc.collect()  # The mapping of the clock.
    report = report_of(findings, time.monotonic() - began, held() - before)
    print(table(report))
    for broken in [*report["broken"], *report["leaks"]]:
        print(f"broken: {broken}")
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    ended_once = sum(report["requests"].values()) == sum(report["ends"].values())
    return 0 if ended_once and not report["broken"] and not report["leaks"] else 1


if __name__ == "__main__":
    sys.exit(main())
