"""What the runs of all kinds of programs have in common: a group, its life, and one operation after
the other.

Each operation is a coroutine, for groups of both kinds: `Session.done` awaits what must be awaited.
An operation that a program's state doesn't allow does nothing, so any part of a program is one.
"""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import os
import signal
import time
import warnings
from collections import Counter
from functools import partial
from random import Random
from typing import TYPE_CHECKING, Any

import numpy as np
from simulator.model import Env, Violation, require
from simulator.scripted import DYING, FIXED, RAISING, TOKENS, Act, encoded

import rlightning_aio
import rlightning_aio.sync
from rlightning_aio import errors
from rlightning_aio.errors import StartFailed

if TYPE_CHECKING:
    from collections.abc import Coroutine, Iterator, Sequence

    from simulator.clients import Client
    from simulator.program import Op, Plan, Program


class Session:
    """One run of a program.

    Attributes:
        counts: what was done and what came of it.
        hang: seconds after which a call that must end counts as hung; processes of a world may be
            stopped for minutes.
        envs: of the group, as the model knows them.
        unclosable: envs that may raise when they are closed.
        clients: that lend envs to an env_server; address: of that.
    """

    group: Any
    envs: list[Env]
    clients: Sequence[Client] = ()

    def __init__(self, program: Program, world: Any = None) -> None:
        self.program, self.world = program, world
        self.features = program.features
        self.hang = 200.0 if world is None else 1e6
        self.is_async = "async" in program.features
        self.counts: Counter[str] = Counter()
        self.is_calm = False
        self.unclosable: set[str] = set()

    # -- a run

    def run(self) -> None:
        """Play the program; raises `Violation`."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            main = self.main()
            if not self.is_async:
                with contextlib.suppress(StopIteration):
                    main.send(None)
                    raise Violation("a synchronous group has to be awaited")
            elif self.world is None:
                asyncio.run(main)
            else:
                self.world.run(main)

    async def main(self) -> None:
        """Start the group, do the operations, and close it."""
        self.build()
        in_midst = self.world is not None and self.program.seed % 4 == 2
        try:
            self.calm()
            if not await self.start():
                return
            self.envs = self.program.envs(self.group.get_workers(), self.world)
            self.clients = [env.client for env in self.envs if env.client is not None]
            if self.clients:
                self.address = self.group[self.clients[0].env.env_id.partition("/")[0]].address
            self.begin()
            for number, op in enumerate(self.program.ops):
                await self.play(number, op)
            self.calm()
            self.say("calm")
            if in_midst:
                self.counts["closed in the midst"] += 1
                with contextlib.suppress(errors.RLightningError):  # Of a lost or a busy env.
                    idle = [id_ for id_ in self.group.env_ids if id_ not in self.group.pending]
                    self.group.reset_async(seed=1, env_ids=idle)
            else:
                await self.finish()
        finally:
            self.calm()
            await self.close()
        if self.world is not None:
            require(not self.world.wrongs, "wrong", *self.world.wrongs)
        if not in_midst:
            self.end()

    def build(self) -> None:
        """Make the group."""
        build = rlightning_aio if self.is_async else rlightning_aio.sync
        self.group = build.build_env_group(
            self.program.configs(), mixed_actions=True, zero_copy="zero_copy" in self.features
        )

    def begin(self) -> None:
        """Look at the group before the first operation."""

    async def finish(self) -> None:
        """Faults are over: whatever is pending must end, and every env be usable."""

    def end(self) -> None:
        """Look at what is left when the group is closed."""

    async def start(self) -> bool:
        """Start the envs; False if they can't be, as is meant."""
        broken = [plan.name for plan in self.program.plans if plan.start]
        try:
            await self.done(self.group.init())
        except StartFailed as error:
            self.count(error)
            self.counts["start failed"] += 1
            require(error.env_id.rpartition("-")[0] in broken, "a start failed", repr(error))
            return False
        require(not broken, "started, and it can't", broken)
        return True

    async def close(self) -> None:
        """Close the group; what is said of envs that don't close must be true."""
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            try:
                await self.done(self.close_group())
            except KeyboardInterrupt:
                raised = self.counts["Ctrl-C"]
                require(self.num_interrupts > raised, "nobody has pressed Ctrl-C")
        texts = [str(one.message) for one in said if "close() of env" in str(one.message)]
        self.counts["close raised"] += len(texts)
        for text in texts:
            own = any(f"'{env_id}'" in text for env_id in self.unclosable)
            require(own or "its worker" in text, "a warning", text)

    def close_group(self) -> Any:
        """Close what `build` or `start` has made."""
        return self.group.close()

    async def play(self, number: int, op: Op) -> None:
        """Do an operation."""
        self.is_calm = False
        if self.world is not None:
            self.world.reseed(op.seed)
            self.world.storm()
        self.say(f"{number}: {op.name}")
        await self.interruptible(getattr(self, f"op_{op.name}")(Random(op.seed)))
        self.counts[f"op {op.name}"] += 1
        if self.world is not None:
            require(not self.world.wrongs, "wrong", *self.world.wrongs)

    async def interruptible(self, doing: Coroutine[Any, Any, Any]) -> Any:
        """Do something that Ctrl-C may interrupt; None if it did."""
        try:
            return await doing
        except KeyboardInterrupt:
            self.counts["Ctrl-C"] += 1
            self.say("   Ctrl-C was raised")
            self.note_interrupt()

    def note_interrupt(self) -> None:
        """Ctrl-C was raised."""

    @property
    def num_interrupts(self) -> int:
        """How often Ctrl-C was pressed, and raised in the call."""
        counts: Counter[str] = Counter() if self.world is None else self.world.counts
        return counts["interrupts"] - counts["interrupts again"]

    async def done(self, answer: Any) -> Any:
        """What a call returns, whichever kind of group it is of."""
        return await answer if inspect.isawaitable(answer) else answer

    # -- the world

    def say(self, text: str) -> None:
        """Add a line to the trace."""
        if self.world is not None:
            self.world.note(text)

    def calm(self) -> None:
        """Let nothing go wrong by itself."""
        self.is_calm = True
        if self.world is not None:
            self.world.calm()

    async def rest(self, tenths: int = 1) -> None:
        """Let others do what they still have to do."""
        if self.is_async:
            await asyncio.sleep(tenths / 10)
        else:
            time.sleep(tenths / 10)  # noqa: ASYNC251  # Nothing else waits.

    async def op_kill(self, rng: Random) -> None:
        """End a worker from outside."""
        self.kill_soon(rng, self.envs)

    def kill_soon(self, rng: Random, envs: Sequence[Env]) -> Env | None:
        """End the worker of one of these envs, in a world also a little later; return the env."""
        envs = [env for env in envs if self.is_killable(env)]
        if not envs:
            return None
        env, delay = rng.choice(envs), rng.choice([0.0, 1e-5, 1e-4, 1e-3, 1e-2, 0.1])
        env.host.struck = True
        pids = [w["pid"] for w in self.group.get_workers() if env.env_id in w["env_ids"]]
        if self.world is None:
            env.host.ask()
            if pids[0] is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pids[0], signal.SIGKILL)
        elif delay:
            self.world.after(delay, lambda: self.is_calm or self.world.kill(pids))
        else:
            self.world.kill(pids)
        return env

    async def op_client(self, rng: Random) -> None:
        """Start a client, or do something to it."""
        if rng.random() < 0.3:  # Let it come back.
            await self.rest(rng.choice([10, 100, 400]))
            return
        client = rng.choice(self.clients)
        process = client.process
        if process is None or not process.alive:
            client.start(self.address)
            return
        kind = rng.choice(["cut", "stop", "kill", "leave"])
        self.counts[f"clients: {kind}"] += 1
        delay = rng.choice([0.0, 1e-4, 1e-3, 1e-2, 0.1, 1.0])
        act = {
            "cut": process.cut,
            "stop": partial(process.stop, rng.choice([0.03, 1.0, 5.0, 40.0])),
            "kill": partial(process.end, -9),
            "leave": client.leave,
        }[kind]
        self.world.after(delay, lambda: self.is_calm or not process.alive or act())
        if rng.random() < 0.6:  # Somebody starts it again.
            again = lambda: client.is_alive or client.start(self.address)  # noqa: E731
            self.world.after(delay + rng.choice([0.0, 0.1, 3.0, 30.0]), again)

    # -- errors

    @contextlib.contextmanager
    def expected(self, kind: Any, what: str) -> Iterator[None]:
        """Require an error, by which nothing changes."""
        try:
            yield
        except kind as error:
            self.count(error)
            return
        raise Violation(f"not refused: {what}")

    def count(self, error: BaseException) -> None:
        """Count an error by its public class."""
        kinds = [kind.__name__ for kind in type(error).__mro__]
        self.counts[next((k for k in kinds if k in errors.__all__), kinds[0])] += 1
        self.counts["EnvError"] += getattr(error, "exception_type", "").endswith("EnvError")

    # -- drawing

    def plan(self, env: Env) -> Plan:
        return next(plan for plan in self.program.plans if plan.name == env.entry.name)

    def is_killable(self, env: Env) -> bool:
        """The env is in another process."""
        return env.host.mortal and self.plan(env).placement not in ("loop", "client")

    def may_raise_in_reset(self, env: Env) -> bool:
        """An env that goes on after that is as it was, unless the next worker has it then."""
        return not self.plan(env).recycle or env.entry.on_error == "restart"

    def acts(self, rng: Random, env: Env, *, plain: bool = False) -> list[Act]:
        """What the sub-environments of an env are to do, now and then all the same."""
        if rng.random() < 0.3:
            return [self.act(rng, env, plain=plain)] * len(env.codes)
        return [self.act(rng, env, plain=plain) for _ in env.codes]

    def act(self, rng: Random, env: Env, *, plain: bool) -> Act:
        features, token = self.features, rng.randrange(TOKENS)
        effects = ["plain"] * 6
        effects += ["end", "cut", "both"] * ("ends" in features)
        effects += ["info", "info", "info", "nested"] * ("infos" in features)
        effects += ["slow"] * ("slow" in features)
        effect = rng.choice(effects)
        if plain or rng.random() > 0.15:
            return effect, token
        faults = self.faults_of(env)
        effect = rng.choice(faults) if faults else effect
        if effect.removesuffix(" next") in (*DYING, "die", "hang"):
            env.host.ask()  # Only a world counts deaths by itself.
        if effect.removesuffix(" next") in (*RAISING, "rubbish"):
            env.exceptions += env.entry.on_error == "restart"
        return effect, token

    def faults_of(self, env: Env) -> list[str]:
        """The faults that an env may have."""
        features, entry = self.features, env.entry
        if env.client is not None:
            faults = ["raise"] * ("raise" in features)
            faults += ["rubbish"] * ("rubbish" in features and entry.layout in (*FIXED, "number"))
            faults += [*DYING, "raise oddly"] * ("die" in features)
            return faults + ["hang"] * (self.plan(env).timeout is not None)
        # Such an env begins with a fresh generator in the next worker.
        keeps = "snapshots" in features and not self.plan(env).recycle
        faults = ["keep state"] * keeps
        if "raise" in features:
            faults += ["raise", "raise oddly"] + ["raise next"] * self.may_raise_in_reset(env)
            if not self.is_async and self.plan(env).placement == "inline":
                faults.append("ctrl-c")
        if "rubbish" in features and entry.layout in (*FIXED, "number"):
            faults.append("rubbish")
        if "die" in features and self.is_killable(env):
            faults += [*DYING, "die next"]
        if env.host.mortal and self.plan(env).timeout is not None:
            faults += ["hang", "hang next"]
        return faults


def action_of(env: Env, acts: Sequence[Act]) -> Any:
    """The action that has an env do this."""
    actions = [encoded(env.entry.controls, *act) for act in acts]
    return actions[0] if env.entry.form != "stacked" else stacked(actions)


def stacked(actions: Sequence[Any]) -> Any:
    """Actions of the same space as columns; a list of those that have no fixed size."""
    first = actions[0]
    if isinstance(first, dict) and "do" not in first:
        return {key: stacked([one[key] for one in actions]) for key in first}
    if isinstance(first, tuple):
        return tuple(stacked(column) for column in zip(*actions, strict=True))
    if isinstance(first, str | dict):
        return list(actions)
    return np.array(actions)
