"""The requests to one group's envs, and their ends.

`Books` opens a request before it is sent, and closes it with the result or the error that ends it.
A second end, an end without a request, or none within `LONGEST_WAIT` breaks a promise; so does a
result that `chaos_judge` finds to be false.
"""

from __future__ import annotations

import os
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from chaos_judge import RAISING, Env, Lie, Request, Row, judge
from chaos_processes import Processes
from witness import vector_of

from rlightning_aio.errors import EnvAway, EnvFault, EnvRaised, WorkerDied

if TYPE_CHECKING:
    import random

LONGEST_WAIT = 120.0
"""Seconds after which a request counts as lost, and a group that does nothing as hung."""
SERVER = "far-0"


class Broken(Exception):
    """A promise was broken, and later checks would mean nothing."""


def require(right: Any, otherwise: str, *details: Any) -> None:
    """Raise `Broken` if a condition is false."""
    if not right:
        raise Broken(f"{otherwise} {details or ''}")


@dataclass
class Tally:
    """The numbers of events in groups' lives."""

    requests: Counter[str] = field(default_factory=Counter)
    ends: Counter[str] = field(default_factory=Counter)
    drivers: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    interrupted: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    lives: Counter[str] = field(default_factory=Counter)
    unasked: int = 0
    longest_wait: float = 0.0
    broken: list[str] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Add another tally."""
        for name, value in vars(self).items():
            if isinstance(value, Counter):
                value.update(getattr(other, name))
        self.unasked += other.unasked
        self.longest_wait = max(self.longest_wait, other.longest_wait)
        self.broken += other.broken


class Books:
    """The requests of one group; see the module's docstring.

    Args:
        entries: of the group.
        client_names: of clients that may connect.
        waits: the driver: ``asyncio``, ``uvloop`` or ``sync``.
        zero_copy: results are views, which may be overwritten.

    Attributes:
        envs: by id; clients as they come.
        limit: of `auto_reset`, while that is on.
        doomed: processes, and lives of awaitable envs, that may end because of a fault.
    """

    def __init__(
        self,
        entries: list[dict[str, Any]],
        client_names: list[str],
        tally: Tally,
        rng: random.Random,
        *,
        waits: str,
        zero_copy: bool,
    ) -> None:
        self.envs: dict[str, Env] = {}
        self.processes = Processes()
        self.limit: int | None = None
        self.doomed: set[float] = set()
        self._tally = tally
        self._rng = rng
        self._client_names = client_names
        self._waits = waits
        self._zero_copy = zero_copy
        self._held: deque[tuple[Any, Any]] = deque(maxlen=16)
        for entry in entries:
            if entry["backend"] != "env_server":
                self._add_envs(entry)

    def _add_envs(self, entry: dict[str, Any]) -> None:
        for k in range(entry["num_workers"]):
            env_id = f"{entry['name']}-{k}"
            self.envs[env_id] = Env(
                env_id,
                k,
                entry.get("placement", "process"),
                entry["env_kwargs"].get("layout", "vector"),
                brittle=entry.get("on_worker_death") == "raise",
                awaitable=entry["backend"] == "awaitable witness",
            )

    def idle(self, *, clients: bool = True) -> list[Env]:
        """Return the envs that can get a request."""
        return [e for e in self.envs.values() if e.idle and (clients or e.place != "client")]

    def owed(self) -> list[Env]:
        """Return the envs whose reply a collect will return."""
        return [e for e in self.envs.values() if e.request and e.request.to_collector]

    def open(self, env: Env, kind: str, **fields: Any) -> Request:
        """Record a request that is about to be sent."""
        require(env.request is None, "the chaos itself has asked twice", env.env_id)
        env.request = Request(kind, time.monotonic(), is_due=env.due, **fields)
        self._tally.requests[f"{kind} ({env.place})"] += 1
        return env.request

    def close(self, env: Env, how: str) -> Request:
        """Record the reply to a request, or its refusal."""
        request, env.request = env.request, None
        if request is None:
            raise Broken(f"{env} answered ({how}) although nothing was asked of it")
        self._tally.ends[how] += 1
        waited = time.monotonic() - request.since
        self._tally.longest_wait = max(self._tally.longest_wait, waited)
        return request

    def check_waits(self) -> None:
        """Check that no request waits for too long, and that earlier results are unchanged."""
        now = time.monotonic()
        for env in self.envs.values():
            since = env.limbo if env.request is None else env.request.since
            require(since is None or now - since < LONGEST_WAIT, "no answer for too long", env)
        if self._held and self._rng.random() < 0.1:
            given, copied = self._held.popleft()
            require(np.array_equal(given, copied), "a result was overwritten")

    def end(self) -> None:
        """Record that the group is closed."""
        for env in self.envs.values():
            if env.request is not None:
                self.close(env, "closed with its group")
        self._held.clear()

    # -- results ------------------------------------------------------------------

    def take(self, batch: Any, call: str, flags: list[bool] | None = None) -> None:
        """Compare each result with its request."""
        if flags is not None:
            require(flags == batch.limit_reached.tolist(), "flags", call, flags)
        self._hold(batch)
        tokens: list[float] | None = []
        for (batch_id, ret), row in zip(batch.items(), self._rows(batch), strict=True):
            env = self._env_of(batch_id, ret)
            request = env.request
            row.named = vector_of(env.layout, ret.observation)
            if request is not None and call == "collect":
                fair = request.to_collector or request.given_up
                require(fair, "collected while somebody waited for it", env)
            self._end(env, request, row, call)
            if request is None or request.kind != "step" or env.place == "client":
                tokens = None
            elif tokens is not None:
                tokens.append(request.token)
        if tokens and self._rng.random() < 0.3:
            sent = [float(one) for one in batch.sent.token]
            require(sent == tokens, "another request was sent", sent, tokens)

    def _rows(self, batch: Any) -> list[Row]:
        """Return results by column, and check that they equal the single results."""
        columns = (batch.reward, batch.terminated, batch.truncated, batch.is_reset)
        columns = (*columns, batch.restarted, batch.limit_reached)
        found: list[Row] = []
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for ret, values in zip(batch.values(), rows, strict=True):
            found.append(Row(np.empty(0), *values, ret.info))
            alike = values[:3] == (ret.last_reward, ret.last_terminated, ret.last_truncated)
            require(alike, "columns and values differ", values, ret)
        return found

    def _env_of(self, batch_id: str, ret: Any) -> Env:
        env = self.envs.get(ret.env_id)
        if env is not None:
            expected = SERVER if env.place == "client" else env.env_id
            require(batch_id == expected, "another id", batch_id, env)
            return env
        name = ret.env_id.removeprefix(f"{SERVER}/")
        if batch_id != SERVER or name not in self._client_names:
            raise Broken(f"{batch_id}: a result of a stranger: {ret}")
        env = self.envs[ret.env_id] = Env(ret.env_id, int(name[1:]), "client", "vector")
        return env

    def _end(self, env: Env, request: Request | None, row: Row, call: str) -> None:
        life, *before = env.life, env.pid, env.parent
        try:
            how = judge(env, request, row, self.limit)
        except Lie as found:
            self._tally.broken.append(f"{found}: {call}: {env}, {request}, in {row}")
            how = "a lie"
        if env.life != life:
            self.processes.forget(before[0])
        if how == "marked" and self.doomed.isdisjoint((life, *before)):
            self._tally.unasked += 1
        if request is None:
            self._tally.drivers["unasked, of a client"] += 1
        else:
            self.close(env, how)
            self._tally.drivers[self._waits] += 1
        if env.pid:
            self.processes.hold(env.pid, env.parent)
            if env.place == "process":
                self.processes.hold(env.parent, os.getpid())

    def _hold(self, batch: Any) -> None:
        """Keep a result, to check later that it is unchanged."""
        if self._zero_copy or self._rng.random() > 0.3 or len(batch.by_name()) > 1:
            return
        observation = batch.observation
        if isinstance(observation, np.ndarray):
            self._held.append((observation, observation.copy()))

    # -- errors -------------------------------------------------------------------

    def failed(self, fault: EnvFault, asked: list[Env] | None = None) -> None:
        """End the requests that a typed error names, and take the results that it has."""
        faults = [fault, *fault.others]
        named = [(one, env_id) for one in faults for env_id in _ids(one)]
        if asked is not None:
            got = [] if fault.results is None else [r.env_id for r in fault.results.values()]
            told = sorted([*(env_id for _, env_id in named), *got])
            ids = sorted(env.env_id for env in asked)
            require(told == ids, "an error for others", told, ids, fault)
        for one, env_id in named:
            env = self.envs.get(env_id)
            if env is None:
                raise Broken(f"an error of a stranger: {one!r}")
            self._judge_fault(env, self.close(env, type(one).__name__), one)
        if fault.results is not None:
            self.take(fault.results, "results of an error")

    def _judge_fault(self, env: Env, request: Request, fault: EnvFault) -> None:
        if isinstance(fault, EnvRaised):
            instead = request.is_due and request.kind == "step"
            right = request.fault in RAISING and not instead
            if request.fault == "raise":
                right = right and fault.exception_text == "as asked for"
        elif isinstance(fault, WorkerDied):
            right = env.brittle
            env.gone = True
        else:
            right = isinstance(fault, EnvAway) and env.place == "client"
        if not right:
            self._tally.broken.append(f"{env}, {request}: {fault!r} {fault.__cause__}")


def _ids(fault: EnvFault) -> tuple[str, ...]:
    return getattr(fault, "env_ids", ()) or (fault.env_id,)
