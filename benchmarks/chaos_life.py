"""One group from its first reset to its end: its requests, and how they are collected.

Any operation of an asynchronous group may be cancelled at a random moment, or run in parallel with
others; a collect then returns its results.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from chaos_books import LONGEST_WAIT, SERVER, Books, Broken, Tally, require
from chaos_judge import AWAITING, DYING, HANGING, RAISING, Env
from chaos_strikes import Strikes
from witness import CODES

import rlightning_aio as rl
from rlightning_aio.errors import (
    BadAction,
    EnvBusy,
    EnvFault,
    EnvRaised,
    GroupClosed,
    NothingPending,
    RLightningError,
    UnknownEnv,
    WorkerDied,
)

if TYPE_CHECKING:
    import random
    from collections.abc import Callable, Coroutine, Iterable

HEARTBEAT = 1.0
CLIENTS = 2
PATIENCE = 0.5
"""Seconds that a collect may take before other tasks get a turn."""
FORKING = ("fork, child exits", "fork, child raises", "fork, child leaves")
NOISY = ("flood stderr", "big info", "nested info")
STEP_FAULTS = {
    **dict.fromkeys(RAISING, 2.0),
    **dict.fromkeys(DYING, 6.0),
    **dict.fromkeys(HANGING, 0.6),
    **dict.fromkeys(FORKING, 2.0),
    **dict.fromkeys(NOISY, 2.0),
    "lag": 2.0,
}
"""Faults of actions, and their frequencies."""
INLINE_FAULTS = (*(n for n in RAISING if n != "raise KeyboardInterrupt"), *NOISY)
"""Faults for an env in the trainer's process: the others would end the trainer."""
AWAITED_FAULTS = {
    "await forever": 3.0,
    "ignore cancellation": 1.0,
    "leave a task": 3.0,
    "block": 1.0,
}
"""Faults that only awaitable envs have, and their frequencies."""
LOOP_FAULTS = {**dict.fromkeys((*INLINE_FAULTS, "lag"), 2.0), **AWAITED_FAULTS}
"""Faults for an awaitable env on the trainer's event loop, and their frequencies."""
CLIENT_FAULTS = ("raise", "raise oddly", "exit", "crash", "nap", *NOISY, "lag")


class Awaited:
    """A synchronous group with the asynchronous interface; nothing suspends."""

    def __init__(self, group: Any) -> None:
        self._group = group

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._group, name)
        if name not in ("init", "reset", "step", "collect_async", "close"):
            return found

        async def awaited(*args: Any, **kwargs: Any) -> Any:
            return found(*args, **kwargs)

        return awaited

    def __getitem__(self, env_id: str) -> Any:
        return AwaitedHandle(self._group[env_id])


class AwaitedHandle:
    """A handle of such a group."""

    def __init__(self, handle: Any) -> None:
        self._handle = handle

    @property
    def address(self) -> str:
        return self._handle.address

    async def call(self, *args: Any) -> Any:
        return self._handle.call(*args)

    async def get_attr(self, *args: Any) -> Any:
        return self._handle.get_attr(*args)

    async def set_attr(self, *args: Any) -> Any:
        return self._handle.set_attr(*args)


class Life:
    """The life of one group; see the module's docstring.

    Args:
        group: initialised.
        world: the rest of the chaos: `take_fault`, `after`, `command_keeper`, `beat`, `is_over`.
        orders: the faults of the next build of each env.
        client_names: of clients that must connect; empty without an env_server.
        waits: ``asyncio``, ``uvloop`` or ``sync``.
    """

    def __init__(
        self,
        group: Any,
        world: Any,
        books: Books,
        orders: Any,
        client_names: list[str],
        tally: Tally,
        rng: random.Random,
        *,
        waits: str,
    ) -> None:
        self.books = books
        self.rng = rng
        self._group = group
        self._world = world
        self._tally = tally
        self._is_sync = waits == "sync"
        self._client_names = client_names
        self._local = list(books.envs.values())
        self._sides: set[asyncio.Task[None]] = set()
        self._token = 0.0
        self._auto: Any = None
        flood = self._flood if client_names else None
        self._strikes = Strikes(books, orders, rng, world.after, flood)

    # -- the life -----------------------------------------------------------------

    async def run(self, quota: int) -> None:
        """Run until its share of faults is done; then close the group in one way or another."""
        try:
            await self._begin()
            while quota > 0 and not self._world.is_over():
                before = self._tally.faults.total()
                await self._turn()
                quota -= self._tally.faults.total() - before
            if self.rng.random() < 0.6 or self._world.is_over():
                await self._settle()
                self._tally.lives["closed at peace"] += 1
            else:
                self._tally.lives["closed amid requests"] += 1
        finally:
            await self._end()

    async def _begin(self) -> None:
        for name in self._client_names:
            self._world.command_keeper(f"keep {name} {self._address()} {HEARTBEAT}")
        seed = self.rng.randrange(1000)
        for k, env in enumerate(self._local):
            self.books.open(env, "reset", to_collector=False, seed=seed + k)
        batch, _ = await self._group.reset(seed=seed)
        self.books.take(batch, "reset")
        require(not any(env.request for env in self._local), "not all were reset")

    def _address(self) -> str:
        host, _, port = self._group[SERVER].address.removeprefix("tcp://").rpartition(":")
        return f"{host} {port}"

    def _flood(self) -> None:
        self._world.command_keeper(f"flood {self._address()} {self.rng.randrange(10**9)}")

    async def _turn(self) -> None:
        rng = self.rng
        self._world.beat()
        self.books.check_waits()
        if rng.random() < 0.02 and not self._client_names:
            # The effect of a client's connections on its counter is not checked here.
            await self._switch_auto_reset()
        if rng.random() < 0.05:
            await self._misuse()
        if rng.random() < 0.15:
            struck = self._strikes.strike()
            if struck is not None:
                # One fault too many does no harm.
                self._world.take_fault()
                self._tally.faults[struck] += 1
        await self._ask()
        if rng.random() < 0.9:
            await self._collect()
        else:
            await self._pause(rng.choice((0.0, 0.0005, 0.005)))
        self._reap()

    async def _pause(self, seconds: float) -> None:
        if self._is_sync:
            time.sleep(seconds)  # noqa: ASYNC251  # Its thread is its own.
        else:
            await asyncio.sleep(seconds)

    async def _settle(self) -> None:
        """Let all requests end; then check that all envs can be reset and stepped."""
        await self._quiet()
        if self._auto is not None:
            self._leave_auto_reset()
        local = [env for env in self.books.idle(clients=False) if not env.brittle]
        await self._plain_reset(local)
        self._send([env for env in local if env.idle], allow_faults=False)
        await self._quiet()

    async def _quiet(self) -> None:
        """Wait until no env has a request."""
        while True:
            self._world.beat()
            self.books.check_waits()
            self._reap()
            self._free_limbo()
            if self.books.owed():
                await self._collect(kindly=True)
            elif self._sides or any(env.limbo for env in self.books.envs.values()):
                await self._pause(0.005)
            else:
                return

    async def _end(self) -> None:
        if self._auto is not None:
            self._leave_auto_reset()
        for name in self._client_names:
            self._world.command_keeper(f"drop {name}")
        try:
            if not self._is_sync and self.rng.random() < 0.15:
                await self._cancel_close()
            await self._group.close()
            await self._group.close()
        finally:
            self._world.beat()
            self.books.processes.close()
            if self._sides:
                await asyncio.wait(self._sides, timeout=LONGEST_WAIT)
            self._reap()
        self.books.end()

    async def _cancel_close(self) -> None:
        self._tally.interrupted["close cancelled"] += 1
        task = asyncio.ensure_future(self._group.close())
        await asyncio.sleep(self.rng.choice((0.0, 0.001, 0.05)))
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    def _reap(self) -> None:
        for task in [task for task in self._sides if task.done()]:
            self._sides.discard(task)
            task.result()

    # -- steps --------------------------------------------------------------------

    async def _ask(self) -> None:
        rng = self.rng
        if rng.random() < 0.3:
            self._free_limbo()
        idle = self.books.idle()
        if not idle:
            return
        kind = rng.random()
        if kind < 0.80:
            chosen = [env for env in idle if rng.random() < 0.8] or idle
            # An env that is gone for good makes the group refuse the whole batch, as it should.
            for env in chosen:
                if env.brittle:
                    self._send([env])
            self._send([env for env in chosen if not env.brittle])
            return
        clients = [env for env in idle if env.place == "client"]
        local = [env for env in idle if env.place != "client" and not env.brittle]
        if kind > 0.99 and clients:
            await self._beside(self._reset([rng.choice(clients)]))
        elif local:
            some = rng.sample(local, rng.randint(1, len(local)))
            if kind < 0.87:
                await self._beside(self._reset(some))
            elif kind < 0.93:
                await self._beside(self._step(some))
            else:
                await self._beside(self._call(some[0]))

    async def _beside(self, doing: Coroutine[Any, Any, None]) -> None:
        """Run it; in an asynchronous group, in parallel with everything else."""
        if self._is_sync:
            await doing
            return
        self._sides.add(asyncio.ensure_future(doing))
        if self.rng.random() < 0.5:
            await asyncio.sleep(0)

    def _steps(self, envs: list[Env], *, allow_faults: bool, to_collector: bool) -> Any:
        ids, responses = [], []
        for env in envs:
            self._token += 1.0
            fault = self._fault_for(env) if allow_faults else "nothing"
            self.books.open(env, "step", token=self._token, fault=fault, to_collector=to_collector)
            action = np.array([CODES[fault], self._token])
            ids.append(SERVER if env.place == "client" else env.env_id)
            responses.append(rl.PolicyResponse(env.env_id, action=action, token=self._token))
        return rl.BatchedData(ids, responses)

    def _fault_for(self, env: Env) -> str:
        rng = self.rng
        if rng.random() > 0.6:
            return "end" if rng.random() < 0.05 else "nothing"
        if env.place == "process":
            faults = STEP_FAULTS | AWAITED_FAULTS if env.awaitable else STEP_FAULTS
            name = rng.choices(list(faults), list(faults.values()))[0]
        elif env.place == "loop":
            name = rng.choices(list(LOOP_FAULTS), list(LOOP_FAULTS.values()))[0]
        else:
            name = rng.choice(INLINE_FAULTS if env.place == "inline" else CLIENT_FAULTS)
        if not self._world.take_fault():
            return "nothing"
        self._tally.faults[f"{name} ({env.place})"] += 1
        if name in (*DYING, *HANGING, *FORKING):
            self.books.doomed.add(env.pid)
        elif name in AWAITING:
            self.books.doomed.add(env.life)
        return name

    def _send(self, envs: list[Env], *, allow_faults: bool = True) -> None:
        if not envs:
            return
        batch = self._steps(envs, allow_faults=allow_faults, to_collector=True)
        try:
            self._group.step_async(batch)
        except WorkerDied as died:
            require(len(envs) == 1 and envs[0].brittle, "step_async raised", died, envs)
            self.books.close(envs[0], "refused: it is gone")
            envs[0].gone = True

    async def _step(self, envs: list[Env]) -> None:
        """Call `step`, for the results of all envs in their order."""
        envs = [env for env in envs if env.idle]  # Some may have got requests meanwhile.
        if not envs:
            return
        batch = self._steps(envs, allow_faults=True, to_collector=False)
        answer = await self._answer(self._group.step(batch), envs, "step")
        if answer is not None:
            results, flags = answer
            require(results.ids() == [env.env_id for env in envs], "a step in another order")
            require((flags is None) == (self._auto is None), "flags of a step", flags)
            self.books.take(results, "step", flags)

    async def _answer(self, doing: Coroutine[Any, Any, Any], envs: list[Env], what: str) -> Any:
        """Return the result of a call; record the outcome of its requests if it raises."""
        try:
            return await self._cut(doing, envs, f"{what} cancelled")
        except asyncio.CancelledError:
            _hand_to_collector(envs)
        except GroupClosed:
            pass
        except EnvFault as fault:
            self.books.failed(fault, envs)
        return None

    async def _cut(self, doing: Coroutine[Any, Any, Any], envs: list[Env], what: str) -> Any:
        """Return the result of `doing`; sometimes cancel it at a random moment."""
        if self._is_sync or self.rng.random() < 0.8:
            return await doing
        begun = False

        async def begin() -> Any:
            nonlocal begun
            begun = True
            return await doing

        task = asyncio.ensure_future(begin())
        await self._cancel_some_time(task, envs)
        try:
            return await task
        except asyncio.CancelledError:
            self._tally.interrupted[what] += 1
            if not begun:
                doing.close()  # It was cancelled before it had sent anything.
                for env in envs:
                    self.books.close(env, "never sent")
            raise

    async def _cancel_some_time(self, task: asyncio.Task[Any], envs: list[Env]) -> None:
        for _ in range(self.rng.choice((0, 1, 2, 3))):
            await asyncio.sleep(0)
        if self.rng.random() < 0.7:
            await asyncio.wait((task,), timeout=10 ** self.rng.uniform(-4, -1.5))
        if not task.done():
            for env in envs:
                if env.request is not None:
                    env.request.given_up = True
            task.cancel()

    # -- resets -------------------------------------------------------------------

    async def _reset(self, envs: list[Env]) -> None:
        rng = self.rng
        envs = [env for env in envs if env.idle]
        if not envs:
            return
        options, seeds = None, dict.fromkeys((env.env_id for env in envs), -1)
        if envs[0].place == "process" and rng.random() < 0.2 and self._world.take_fault():
            envs = envs[:1]
            options = {"fault": rng.choice((*RAISING, *DYING, *HANGING[:2]))}
            self._tally.faults[f"{options['fault']} (in a reset)"] += 1
            self.books.doomed.add(envs[0].pid)
        elif rng.random() < 0.5:
            seeds = {env.env_id: rng.randrange(10**6) for env in envs}
        fault = "nothing" if options is None else options["fault"]
        later = rng.random() < 0.4
        for env in envs:
            seed = seeds[env.env_id]
            self.books.open(env, "reset", to_collector=later, seed=seed, fault=fault)
        ids = [env.env_id for env in envs]
        given: Any = None if seeds[ids[0]] < 0 else seeds
        if given is not None and rng.random() < 0.5:
            given = [seeds[env_id] for env_id in ids]
        try:
            if later:
                self._group.reset_async(given, options, ids)
                return
            answer = await self._answer(self._group.reset(given, options, ids), envs, "reset")
        except EnvBusy:
            # A client's first result may have come since it was found idle; nothing was sent.
            require(envs[0].place == "client", "busy, and not asked", ids)
            for env in envs:
                self.books.close(env, "refused: busy")
            return
        if answer is not None:
            found = [ret.env_id for ret in answer[0].values()]
            require(found == ids, "a reset in another order", found, ids)
            self.books.take(answer[0], "reset")

    async def _plain_reset(self, envs: list[Env]) -> None:
        if not envs:
            return
        for env in envs:
            self.books.open(env, "reset", to_collector=False)
        try:
            batch, _ = await self._group.reset(env_ids=[env.env_id for env in envs])
        except EnvFault as fault:
            self.books.failed(fault, envs)
        else:
            self.books.take(batch, "reset")

    async def _switch_auto_reset(self) -> None:
        await self._quiet()
        if self._auto is not None:
            self._leave_auto_reset()
            return
        # Counters begin at resets.
        await self._plain_reset([env for env in self.books.idle() if not env.brittle])
        await self._plain_reset([env for env in self.books.idle() if env.brittle])
        self.books.limit = self.rng.randint(1, 12)
        self._auto = self._group.auto_reset(self.books.limit)
        self._auto.__enter__()
        for env in self._local:
            env.begin_count()

    def _leave_auto_reset(self) -> None:
        auto, self._auto, self.books.limit = self._auto, None, None
        auto.__exit__(None, None, None)
        for env in self._local:
            env.begin_count()

    # -- calls --------------------------------------------------------------------

    async def _call(self, env: Env) -> None:
        """Make a call: of a value, an attribute or a fault."""
        rng = self.rng
        if self._strikes.muted(env) or not env.idle:
            return
        self._token += 1.0
        kind = rng.choice(("describe", "describe", "get", "set", "fault"))
        fault = self._fault_for_call(env) if kind == "fault" else "nothing"
        self.books.open(env, "call", token=self._token, fault=fault, to_collector=False)
        echo = {"token": self._token, "blob": b"x" * rng.choice((1, 99999))}
        try:
            calling = self._calling(self._group[env.env_id], kind, fault, echo)
            value = await self._cut(calling, [env], "call cancelled")
        except asyncio.CancelledError:
            if env.request is not None:
                self.books.close(env, "call given up")
                env.limbo = time.monotonic()
        except GroupClosed:
            pass
        except EnvRaised as raised:
            self.books.close(env, "EnvRaised")
            require(fault in RAISING, "it raised", fault, env, raised, str(raised.__cause__))
        except WorkerDied:
            self.books.close(env, "WorkerDied, of a call")
            require(env.place == "process", "it died", env)
        else:
            self.books.close(env, "value")
            require(fault == "nothing", "it returned", fault, env, value)
            if kind == "describe":
                _check_told(env, value, echo)

    def _fault_for_call(self, env: Env) -> str:
        if not self._world.take_fault():
            return "nothing"
        fault = self.rng.choice((*RAISING, *DYING) if env.place == "process" else RAISING[:3])
        self._tally.faults[f"{fault} (in a call)"] += 1
        self.books.doomed.add(env.pid)
        return fault

    def _calling(
        self, handle: Any, kind: str, fault: str, echo: dict[str, Any]
    ) -> Coroutine[Any, Any, Any]:
        if kind == "fault":
            return handle.call("do", fault)
        if kind == "get":
            return handle.get_attr("life")
        if kind == "set":
            return handle.set_attr("note", echo["token"])
        return handle.call("describe", echo)

    def _free_limbo(self) -> None:
        """Find out if envs whose call was cancelled can be used again."""
        for env in self.books.envs.values():
            if env.limbo is None:
                continue
            since, env.limbo = env.limbo, None
            try:
                self._send([env], allow_faults=False)
            except EnvBusy:
                self.books.close(env, "refused: busy")
                env.limbo = since

    # -- misuse -------------------------------------------------------------------

    async def _misuse(self) -> None:
        """Make invalid requests, which must send nothing: later results show it."""
        group, good = self._group, np.array([0.0, 1.0])
        idle = [env for env in self.books.idle(clients=False) if not env.brittle]
        # Requests of other calls may still be in flight; an env whose error waits to be collected
        # can get a new request.
        busy = [
            env
            for env in self.books.owed()
            if env.place != "client"
            and not env.brittle
            and env.request is not None
            and env.request.fault not in RAISING
        ]
        kind = self.rng.choice(("busy", "unknown", "shape", "nothing pending", "second"))
        if kind == "nothing pending":
            if not (self.books.owed() or self._client_names or self._sides):
                await self._refused(NothingPending, group.collect_async)
        elif kind == "second":
            if busy and not self._is_sync and not self._client_names:
                await self._collect_twice()
        elif idle and (busy or kind != "busy"):
            ghost = Env("ghost-0", 0, "process", "vector")
            error, batch = {
                "busy": lambda: (EnvBusy, _same([idle[0], busy[0]], good)),
                "unknown": lambda: (UnknownEnv, _same([idle[0], ghost], good)),
                "shape": lambda: (BadAction, _same(idle[:2], np.zeros(3))),
            }[kind]()
            await self._refused(error, lambda: group.step_async(batch))

    async def _collect_twice(self) -> None:
        first = asyncio.ensure_future(self._collect(kindly=True))
        await asyncio.sleep(0)
        if not first.done():
            await self._refused(RLightningError, self._group.collect_async)
        await first

    async def _refused(self, error: type[Exception], doing: Callable[[], Any]) -> None:
        try:
            result = doing()
            if asyncio.iscoroutine(result):
                result = await result
        except error:
            self._tally.refused[error.__name__] += 1
        else:
            raise Broken(f"no {error.__name__}, but {result!r}")

    # -- collecting ---------------------------------------------------------------

    async def _collect(self, *, kindly: bool = False) -> None:
        """Collect in one of the possible ways; some are cancelled on purpose."""
        rng = self.rng
        owed = self.books.owed()
        local = [env for env in owed if env.place != "client"]
        if not owed and not self._client_names:
            await self._pause(0.001)
            return
        if kindly or not local:
            arguments, seconds = {"deadline": 0.05}, None
        else:
            arguments = self._arguments(local)
            seconds = None if "deadline" in arguments else PATIENCE
        what = "collect cut short"
        if seconds is not None and rng.random() < 0.3:
            what, seconds = "collect cancelled", 10 ** rng.uniform(-5, -1.5)
        requests = [(env, env.request) for env in local]
        try:
            collecting = self._group.collect_async(**arguments)
            batch, flags = await (
                collecting if seconds is None else asyncio.wait_for(collecting, seconds)
            )
        except TimeoutError:
            self._tally.interrupted[what] += 1
        except NothingPending:
            still = [e for e in local if e.request and e.request.to_collector]
            require(not still, "NothingPending", still)
        except EnvFault as fault:
            self.books.failed(fault)
        else:
            _check_collected(batch, arguments)
            self.books.take(batch, "collect", flags)
            if arguments.get("wait_all") and arguments["max_results"] is None:
                missed = [env for env, request in requests if env.request is request]
                require(not missed, "wait_all left some", missed)

    def _arguments(self, local: list[Env]) -> dict[str, Any]:
        rng = self.rng
        arguments: dict[str, Any] = {
            "timeout": rng.choice((None, None, 0.0005, 0.005)),
            "min_results": rng.choice((1, 1, 2, 4)),
            "max_results": rng.choice((None, None, 4, 5)),
            "wait_all": rng.random() < 0.05 and not self._client_names,
            "ordered": rng.random() < 0.2,
        }
        if arguments["wait_all"]:
            arguments["timeout"] = None
        if self._client_names and rng.random() < 0.3:
            arguments["entries"] = list({env.env_id.rpartition("-")[0] for env in local})
        if rng.random() < 0.25:
            arguments["deadline"] = 10 ** rng.uniform(-4, -1.5)
        elif self._is_sync:
            arguments["deadline"] = PATIENCE
        return arguments


def _check_collected(batch: Any, arguments: dict[str, Any]) -> None:
    most = arguments.get("max_results")
    require(0 < len(batch) <= (most or len(batch)), "too many results, or none", len(batch))
    if arguments.get("ordered"):
        order = batch.index.tolist()
        require(order == sorted(order), "not ordered", order)
    if "entries" in arguments:
        found = set(batch.by_name())
        require(found <= set(arguments["entries"]), "another entry", found, arguments)


def _check_told(env: Env, value: Any, echo: dict[str, Any]) -> None:
    index, life, episode, steps, echoed = value
    require(index == env.index and echoed == echo, "it told", env, value)
    if life == env.life:
        require((episode, steps) == (env.episode, env.steps), "it told", env, value)
    else:
        require(env.place == "process" and steps == 0, "it told", env, value)


def _hand_to_collector(envs: list[Env]) -> None:
    for env in envs:
        if env.request is not None:
            env.request.to_collector = True


def _same(envs: Iterable[Env], action: Any) -> Any:
    """Return a batch with the same action for all."""
    ids = [env.env_id for env in envs]
    return rl.BatchedData(ids, [rl.PolicyResponse(env_id, action=action) for env_id in ids])
