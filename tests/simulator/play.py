"""Plays a program of a group: does its operations to the group and to the model, and compares."""

from __future__ import annotations

import asyncio
import contextlib
import math
import pickle
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any

import numpy as np
from simulator.model import (
    COLLECTOR,
    Context,
    Env,
    Model,
    Request,
    Row,
    State,
    Violation,
    require,
    row_of_ret,
    rows_of,
    same,
)
from simulator.program import OPS
from simulator.scripted import DEADLY, DYING, SLOW, TOKENS, UNCLOSABLE, UNLOADABLE
from simulator.session import Session, action_of, stacked
from simulator.world import Faults

from rlightning_aio import BatchedData, PolicyResponse
from rlightning_aio.errors import (
    BadAction,
    EnvAway,
    EnvBusy,
    EnvFault,
    EpisodeLost,
    NothingPending,
    RLightningError,
    SnapshotError,
    UnknownEnv,
    WorkerDied,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable, Sequence

    from simulator.clients import Client
    from simulator.program import Op


class Play(Session):
    """A run of a program that does everything to a group that its model knows."""

    model: Model

    def begin(self) -> None:
        # Results that may be answered again, and states that may be put back.
        self.batches: list[BatchedData] = []
        self.snapshots: list[tuple[bytes, list[tuple[Env, Any]]]] = []
        self.tasks: list[asyncio.Task[None]] = []
        self.context: Any = None
        # Envs whose results were dropped: they may have ended episodes.
        self.unseen: set[str] = set()
        self.trace: Any = None
        self.collecting = False
        self.kept: list[tuple[Any, Any]] = []
        self.unread: list[tuple[BatchedData, list[dict[str, Any]]]] = []
        self.owners = 0
        self.nested: set[str] = set()
        self.written: dict[str, Any] = {}
        faults = replace(self.program.faults, deaths=0.0, interrupts=0.0)
        calm = replace(self.program.faults, lags=0.0, interrupts=0.0) == Faults()
        calm = calm and not {"snapshots", "die"} <= self.features  # States that are put back kill.
        starts_fail = faults != Faults()
        self.model = Model(self.envs, self.counts, starts_fail=starts_fail, calm=calm)
        ids = [env.env_id for env in self.envs]
        require(ids == self.group.env_ids, "ids", self.group.env_ids)
        rng = Random(self.program.seed)
        for client in self.clients:
            if rng.random() < 0.7:
                client.start(self.address)

    async def play(self, number: int, op: Op) -> None:
        await super().play(number, op)
        await self.look_at_tasks()
        self.check_pending()

    was_interrupted = False
    is_stopped = False

    def note_interrupt(self) -> None:
        self.was_interrupted = True
        for env in self.model.pending():
            assert env.request is not None
            env.request.interrupted = not env.host.mortal

    async def close(self) -> None:
        for task in getattr(self, "tasks", ()):
            task.cancel()
        if getattr(self, "tasks", ()):
            await asyncio.wait(self.tasks)
        if hasattr(self, "trace"):  # A program that failed has not stopped it.
            self.stop_trace()
        await super().close()

    def end(self) -> None:
        for client in self.clients:
            client.check_done()
        for columns, copies in self.kept:
            require(same(columns, copies), "a result was overwritten", columns, copies)
        for part, right in self.unread:
            own = [{name: part.sent[name] for name in part.sent}, part.infos]
            require(same(own, right), "sent or infos read differently later", own, right)

    async def look_at_tasks(self, *, wait: bool = False) -> None:
        """Raise what tasks have raised, and forget those that have ended."""
        if wait and self.tasks:
            _, late = await asyncio.wait(self.tasks, timeout=self.hang)
            require(not late, "a call hangs", late)
        for task in [task for task in self.tasks if task.done()]:
            self.tasks.remove(task)
            if not task.cancelled() and task.exception() is not None:
                raise task.exception() or AssertionError

    def check_pending(self) -> None:
        owed = self.model.pending()
        # An episode steps in a task of its own, so its results are handed out a little earlier. An
        # env whose worker has died takes no further part in a restore.
        nested = {env.env_id for env in owed if env.env_id in self.nested or self.is_lost(env)}
        found = set(self.group.pending) - nested
        pending = {env.env_id for env in owed} - nested
        require(found == pending, "pending", sorted(found), "must be", sorted(pending))

    def is_lost(self, env: Env) -> bool:
        """A call waits for it that its worker may have been lost in."""
        return env.request is not None and env.request.kind == "call" and env.may_be_lost

    async def finish(self) -> None:
        await self.look_at_tasks(wait=True)
        for client in self.clients:
            client.revive(self.address)
        for client in self.clients:
            await self.interruptible(self.lose(client))
        while self.model.pending(COLLECTOR):
            await self.interruptible(self.collect(deadline=self.hang))
        if self.context is not None:
            self.leave()
        for env in self.model.envs.values():
            # Errors of the env, or of a call that was given up, may come first; and each call may
            # send no more of the order to start than a narrow channel takes.
            for k in range(30):
                if env.client is not None:
                    env.client.revive(self.address)
                if await self.interruptible(self.use(env)):
                    break
                # It may still be starting.
                await self.rest(1 if self.world is None else 10 ** min(k, 5))
            else:
                raise Violation(f"env {env.env_id} can't be used any more")
        self.check_stats()

    async def use(self, env: Env) -> bool:
        """Reset and step an env."""
        while env.request is not None:
            await self.collect(deadline=self.hang)
        return await self.reset([env]) and await self.step_on([env])

    async def lose(self, client: Client) -> None:
        """A client that is killed as it owes a result is found soon, and the next one answers."""
        env, heartbeat = client.env, self.plan(client.env).heartbeat
        if env.may_be_lost or not (env.idle and env in self.ready()):
            return
        batch, requests = self.response(Random(0), [env], plain=True)
        if [*requests] != [env.env_id]:
            return
        self.send_async(requests, lambda: self.group.step_async(batch))
        assert client.process is not None
        client.process.end(-9)
        client.start(self.address)
        began = self.world.now_ns
        while client.env.request is not None:
            await self.collect(deadline=self.hang)
        took = (self.world.now_ns - began) / 1e9
        require(took <= 1.5 * heartbeat + 30.0, "a dead client is found late", client.name, took)
        self.counts["clients found dead"] += 1

    # -- comparing

    def owner(self) -> int:
        self.owners += 1
        return self.owners

    async def answer(
        self,
        requests: dict[str, Request],
        call: Callable[[], Any],
        take: Callable[[Any], None],
    ) -> bool:
        """Make a call that waits for requests of its own; True if it returned a result."""
        owner = self.owner()
        self.send(requests, owner)
        try:
            found = await self.done(call())
        except EnvFault as fault:
            self.note_faults(fault)
            if isinstance(fault, EnvAway) and {*ids_of(fault)} != {*requests} and not fault.results:
                self.counts["too few clients"] += 1  # Of a reset of everyone: nothing was sent.
                self.withdraw(requests)
                return False
            if next(iter(requests.values())).kind == "call":
                self.fail_values(fault, requests)
            else:
                self.fail(fault, requests, owner)
            return False
        except EnvBusy:
            self.refuse_busy(requests)
            return False
        except asyncio.CancelledError:
            # Perhaps nothing was sent yet: a reset waits first for what is in flight.
            is_reset = next(iter(requests.values())).kind == "reset"
            if self.clients or self.nested & requests.keys() or is_reset:
                self.interrupted(requests, owner)
            self.model.orphan(owner)
            raise
        except KeyboardInterrupt:
            self.interrupted(requests, owner)
            raise
        take(found)
        return True

    async def answer_one(
        self, env: Env, request: Request, call: Callable[[], Any], take: Callable[[Any], None]
    ) -> bool:
        """Make a call of one env; an asynchronous group sends it in the next turn of the loop."""
        if self.is_async:
            self.nested.add(env.env_id)
        try:
            return await self.answer({env.env_id: request}, call, take)
        finally:
            self.nested.discard(env.env_id)

    def send(self, requests: dict[str, Request], owner: Any) -> None:
        for env_id, request in requests.items():
            request.owner = owner
            self.model.send(self.model.envs[env_id], request)

    def interrupted(self, requests: dict[str, Request], owner: Any) -> None:
        """Find out what of an interrupted call was sent; its results wait for a collect."""
        pending = self.group.pending
        for env_id, request in requests.items():
            if env_id not in pending and request.kind != "call":
                self.model.withdraw(self.model.envs[env_id])
        self.model.orphan(owner)

    def withdraw(self, requests: dict[str, Request]) -> None:
        """Note that none of these requests was sent."""
        pending = self.group.pending
        for env_id in requests:
            require(env_id not in pending, "refused, and sent nevertheless", env_id)
            self.model.withdraw(self.model.envs[env_id])

    def refuse_busy(self, requests: dict[str, Request]) -> None:
        """A call that was given up may still run in an env."""
        limbo = any(
            request.before and self.model.envs[env_id].host.mortal  # Others end it by themselves.
            for env_id, request in requests.items()
        )
        require(limbo, "busy, and nothing was asked", *requests)
        self.withdraw(requests)

    def refuse_dead(self, fault: WorkerDied, requests: dict[str, Request]) -> None:
        """An env's worker is gone: the error names those that were asked, and nothing was sent."""
        envs, named = self.model.envs, fault.env_ids
        hosts = [envs[env_id].host for env_id in named[:1]]
        own = [env_id for env_id in requests if envs[env_id].host in hosts]
        if hosts and hosts[0].renewed:
            own = [env_id for env_id in own if env_id in named]
        require(named and sorted(named) == sorted(own), "a refusal of others", repr(fault))
        for env_id in named:
            self.model.died(envs[env_id], fault)
        self.withdraw(requests)

    def fail(self, fault: EnvFault, requests: dict[str, Request], owner: Any) -> None:
        """Take an error, and the results that it carries."""
        results = [] if fault.results is None else fault.results.env_ids()
        named = [env_id for one in (fault, *fault.others) for env_id in ids_of(one)]
        if isinstance(fault, WorkerDied) and {*results, *named} < {*requests}:
            require(not results, "refused with results", repr(fault))
            self.refuse_dead(fault, requests)
            return
        require(sorted([*results, *named]) == sorted(requests), "an error of others", repr(fault))
        self.model.failed(fault, owner)
        if fault.results is not None:
            self.take(fault.results, None, owner)

    def note_faults(self, fault: EnvFault) -> None:
        for one in (fault, *fault.others):
            self.count(one)

    def fail_values(self, fault: EnvFault, requests: dict[str, Request]) -> None:
        """Take an error of a call that answers with values: those of other envs are gone."""
        for one in (fault, *fault.others):
            for env_id in ids_of(one):
                require(env_id in requests, "an error of another call", repr(one))
                if isinstance(one, WorkerDied):
                    self.counts["died in a call"] += 1
                    self.model.died(self.model.envs[env_id], one)
        for env_id in requests:
            self.model.envs[env_id].request = None

    def take(self, batch: BatchedData, flags: Sequence[bool] | None, owner: Any) -> None:
        """Compare a batch with what was asked, and keep it."""
        rows = rows_of(batch, self.model.envs, flags)
        self.say(f"   {'; '.join(map(_shown, rows))}")
        self.model.take(rows, owner)
        self.batches.append(batch)
        del self.batches[:-6]
        self.keep(batch)

    def keep(self, batch: BatchedData) -> None:
        """Keep a batch, to see at the end that nobody wrote to it."""
        parts = list(batch.by_entry().values()) if self.program.plans[1:] else [batch]
        for part in parts:
            columns = [part.reward, part.terminated, part.infos]
            if "zero_copy" not in self.features:
                columns.append(part.observation)
            unread = part.take(list(range(len(part))))
            sent = {name: part.sent[name] for name in part.sent}
            columns.append(sent)
            self.unread.append((unread, pickle.loads(pickle.dumps([sent, part.infos]))))
            self.kept.append((columns, pickle.loads(pickle.dumps(columns))))

    def check_stats(self) -> None:
        """Compare the figures of the group with the episodes that were seen."""
        for env_id, found in self.group.get_env_stats().items():
            if env_id in self.nested or env_id in self.unseen:
                continue
            episodes = self.model.envs[env_id].episodes
            require(found["episodes"] == len(episodes), "episodes", env_id, found, episodes)
            if episodes:
                mean = sum(total for total, _ in episodes) / len(episodes)
                require(math.isclose(found["mean_return"], mean), "mean", env_id, found, mean)

    # -- drawing

    def ready(self) -> list[Env]:
        """Envs that can be stepped."""
        return [env for env in self.model.idle() if env.was_reset and not env.dirty]

    def local(self, envs: list[Env]) -> list[Env]:
        """Those that no client lends."""
        return [env for env in envs if env.client is None]

    def some(self, rng: Random, envs: list[Env]) -> list[Env]:
        """All of these envs, or some in any order."""
        if "partial steps" not in self.features or rng.random() < 0.4:
            return envs
        return rng.sample(envs, rng.randint(1, len(envs))) if envs else []

    def response(
        self, rng: Random, envs: list[Env], *, plain: bool = False
    ) -> tuple[BatchedData, dict[str, Request]]:
        """A batch that steps these envs, and what it asks of each."""
        batch = self.answerable(rng, envs)
        if batch is not None:
            envs = [self.model.envs[env_id] for env_id in batch.env_ids()]
        sent: list[dict[str, Any]] = []
        requests: dict[str, Request] = {}
        extras = "extras" in self.features and rng.random() < 0.7
        for env in envs:
            acts = self.acts(rng, env, plain=plain)
            own: dict[str, Any] = {"action": action_of(env, acts)}
            if extras:
                own |= {"log_prob": rng.random(), "note": f"n{rng.randrange(99)}"}
                own["shift"] = rng.randrange(3)
                if env.entry.form == "base":
                    acts = [(e, (t + own["shift"]) % TOKENS) for e, t in acts]
            sent.append(own)
            requests[env.env_id] = Request("step", acts=acts, sent=own)
        if batch is not None:
            self.written = self.columns(rng, envs, sent)
            return batch.respond(**self.written), requests
        self.written = {}
        values = [PolicyResponse(env.env_id, **own) for env, own in zip(envs, sent, strict=True)]
        return BatchedData([env.env_id for env in envs], values), requests

    def answerable(self, rng: Random, envs: list[Env]) -> BatchedData | None:
        """A batch of results, or a part of one, that has only such envs."""
        allowed = {env.env_id for env in envs}
        if "plain values" in self.features and rng.random() < 0.3:
            return None
        for batch in reversed(self.batches):
            rows = [k for k, env_id in enumerate(batch.env_ids()) if env_id in allowed]
            if not rows:
                continue
            if len(rows) == len(batch) and rng.random() < 0.8:
                return batch
            return batch.take(rows)
        return None

    def columns(self, rng: Random, envs: list[Env], sent: list[dict[str, Any]]) -> dict[str, Any]:
        """The same as columns, or as lists where they can't or may not be."""
        columns: dict[str, Any] = {name: [own[name] for own in sent] for name in sent[0]}
        kinds = {(env.entry.controls, env.entry.form == "stacked", len(env.codes)) for env in envs}
        if len(kinds) == 1 and rng.random() < 0.8:
            columns["action"] = stacked(columns["action"])
        if "log_prob" in columns:
            columns["log_prob"] = np.array(columns["log_prob"])
            columns["shift"] = np.array(columns["shift"])
        return columns

    # -- operations: steps and resets

    async def op_step(self, rng: Random) -> None:
        if envs := await self.steppable(rng):
            await self.step_on(envs, rng)

    async def steppable(self, rng: Random) -> list[Env]:
        """Envs to step; if there are none, do what may lead to some."""
        if not (envs := self.some(rng, self.ready())):
            if self.model.idle():
                await self.op_reset(rng)
            elif self.model.pending(COLLECTOR):
                await self.op_collect(rng)
        return envs

    async def step_on(self, envs: list[Env], rng: Random | None = None) -> bool:
        """Step envs and wait for them; plainly without a generator."""
        batch, requests = self.response(rng or Random(0), envs, plain=rng is None)

        def take(found: Any) -> None:
            results, flags = found
            require((flags is None) == (self.model.context is None), "flags", flags)
            require(results.env_ids() == batch.env_ids(), "another order", results, batch)
            self.take(results, flags, self.owner_of(requests))

        return await self.answer(requests, lambda: self.group.step(batch), take)

    def owner_of(self, requests: dict[str, Request]) -> Any:
        return next(iter(requests.values())).owner

    async def op_step_async(self, rng: Random) -> None:
        if not (envs := await self.steppable(rng)):
            return
        batch, requests = self.response(rng, envs)
        self.send_async(requests, lambda: self.group.step_async(batch))

    def send_async(self, requests: dict[str, Request], call: Callable[[], None]) -> None:
        """Send requests whose results the collector gets."""
        self.send(requests, COLLECTOR)
        try:
            call()
            self.scribble()
        except WorkerDied as fault:
            self.refuse_dead(fault, requests)
        except EnvBusy:
            self.refuse_busy(requests)
        except KeyboardInterrupt:
            self.interrupted(requests, COLLECTOR)
            raise

    def scribble(self) -> None:
        """Write to the columns of a response, which was sent."""
        for column in self.written.values():
            if isinstance(column, np.ndarray):
                column[...] = 1
            elif isinstance(column, list):
                column.clear()

    async def op_collect(self, rng: Random) -> None:
        if not self.model.pending(COLLECTOR) and rng.random() < 0.9:
            await self.op_step_async(rng)
        rules: dict[str, Any] = {}
        if rng.random() < 0.5:
            rules["min_results"] = rng.randint(1, 4)
        if rng.random() < 0.3:
            rules["max_results"] = rules.get("min_results", 1) + rng.randint(0, 2)
        if rng.random() < 0.25:
            rules["wait_all"] = True
        elif "timeouts" in self.features and rng.random() < 0.4:
            rules["timeout"] = rng.choice([0.001, 0.5])
        if "timeouts" in self.features and rng.random() < 0.4:
            rules["deadline"] = rng.choice([0.001, 0.2, self.hang])
        await self.collect(**rules)

    async def collect(self, **rules: Any) -> None:
        """Collect by these rules."""
        if self.collecting:
            with self.expected(RLightningError, "a second collect"):
                await self.done(self.group.collect_async(**rules))
            return
        self.collecting, nothing = True, not self.collectable()
        try:
            batch, flags = await self.done(self.group.collect_async(**rules))
        except TimeoutError as error:
            if isinstance(error, EnvFault):
                self.take_fault(error)
                return
            require(
                rules.get("deadline", self.hang) < self.hang,
                "a deadline that has not passed",
                rules,
            )
            self.counts["deadline"] += 1
            return
        except EnvFault as fault:
            self.take_fault(fault)
            return
        except NothingPending as error:
            self.count(error)
            require(nothing or not self.collectable(), "nothing pending, and something is")
            return
        finally:
            self.collecting = False
        self.check_count(batch, rules)
        require(len(flags) == len(batch), "flags", flags)
        self.take(batch, flags, COLLECTOR)

    def collectable(self) -> list[Env]:
        return self.model.pending(COLLECTOR)

    def take_fault(self, fault: EnvFault) -> None:
        self.note_faults(fault)
        require(fault.results is None and not fault.others, "an error of one request", repr(fault))
        self.model.failed(fault, COLLECTOR, self.group.pending)

    def check_count(self, batch: BatchedData, rules: dict[str, Any]) -> None:
        """As many results as the rules say."""
        there = {env.env_id for env in self.collectable()}
        require({*batch.env_ids()} <= there, "a result that nobody asked for", batch.env_ids())
        most = min(rules.get("max_results") or len(there), len(there))
        need = most if rules.get("wait_all") else min(rules.get("min_results", 1), most)
        require(need <= len(batch) <= most, f"{need} to {most} results", len(batch), rules)
        order = list(self.model.envs)
        places = [order.index(env_id) for env_id in batch.env_ids()]
        require(places == sorted(places), "not in the group's order", places)

    async def op_reset(self, rng: Random) -> None:
        if self.model.pending() and rng.random() < 0.8 and self.may_drop():
            await self.drop(rng)
            return
        envs = self.some(rng, self.model.idle())
        if envs:
            await self.reset(envs, rng)

    def may_drop(self) -> bool:
        """A reset of all envs drops what is in flight, and nothing stops it on the way."""
        known = not ("interrupts" in self.features or self.waits_with_nothing_sent())
        known &= not (self.clients or self.is_stopped)
        return known and self.may_abort() and all(map(self.is_abortable, self.model.pending()))

    def waits_with_nothing_sent(self) -> bool:
        """Whether a task might see a reset of all that waits, for clients or cancelled calls."""
        waits = self.clients or any(env.limbo for env in self.model.envs.values())
        return "tasks" in self.features and bool(waits)

    async def drop(self, rng: Random) -> None:
        """Reset all envs, of which some are busy: their results and errors are dropped."""
        envs = list(self.model.envs.values())
        for env in envs:
            if env.limbo or env.request is not None:
                env.put_away &= env.request is None or env.request.kind == "call"
                self.model.abort(env)
                env.kept.clear()
                env.lost = False  # What has come may have said so, and that it was rebuilt.
                self.unseen.add(env.env_id)
        self.counts["dropped by a reset"] += 1
        await self.reset(envs, rng, drops=True)

    async def reset(
        self, envs: list[Env], rng: Random | None = None, *, drops: bool = False
    ) -> bool:
        others = [env for env in self.model.envs.values() if all(env is not e for e in envs)]
        in_order = [env.env_id for env in envs] == [
            env_id for env_id in self.model.envs if env_id in {env.env_id for env in envs}
        ]
        everyone = in_order and rng is not None and not others
        seed, options, requests = self.resets(envs, rng)
        if rng is not None:
            everyone = drops or (everyone and rng.random() < 0.7)
        if self.waits_with_nothing_sent():
            everyone = False
        if everyone:  # It drops errors that nobody has collected.
            for env in envs:
                env.host.raised = True
        ids = None if everyone else [*requests]

        def take(found: Any) -> None:
            batch, flags = found
            require(flags == [False] * len(batch), "flags", flags)
            owner = self.owner_of(requests)
            require(batch.env_ids() == [*requests], "others, or another order", batch.env_ids())
            self.take(batch, flags, owner)

        return await self.answer(requests, lambda: self.group.reset(seed, options, ids), take)

    def resets(
        self, envs: list[Env], rng: Random | None
    ) -> tuple[Any, dict[str, Any] | None, dict[str, Request]]:
        """Seeds and options of a reset, and what they ask of each env."""
        requests = {env.env_id: Request("reset") for env in envs}
        if rng is None:
            return None, None, requests
        options = None
        if rng.random() < 0.3:
            options = {"token": rng.randrange(TOKENS)}
            raises = "raise" in self.features and rng.random() < 0.3
            if raises and all(map(self.may_raise_in_reset, envs)):
                options["effect"] = rng.choice(["raise", "raise oddly"])
        seed: Any = None
        kind = rng.choice(["none", "int", "list", "mapping"])
        if kind == "int":
            seed = rng.randrange(1000)
            seeds = [seed + env.first for env in envs]
        elif kind == "list":
            seed = seeds = [rng.randrange(1000) for _ in envs]
        elif kind == "mapping":
            chosen = rng.sample(envs, rng.randint(1, len(envs)))
            seed = {env.env_id: rng.randrange(1000) for env in chosen}
            seeds = [seed.get(env.env_id) for env in envs]
        else:
            seeds = [None for _ in envs]
        for request, own in zip(requests.values(), seeds, strict=True):
            request.seed, request.options = own, options
        return seed, options, requests

    async def op_reset_async(self, rng: Random) -> None:
        envs = self.some(rng, self.model.idle())
        if not envs:
            return
        seed, options, requests = self.resets(envs, rng)
        self.send_async(requests, lambda: self.group.reset_async(seed, options, [*requests]))

    async def op_enter(self, rng: Random) -> None:
        if self.nested:
            return
        lacking = [
            env
            for env in self.model.envs.values()
            if env.entry.limit is None and env.entry.mode == "disabled"
        ]
        lacks = bool(lacking)
        own = [None] * (1 if lacks else 6)
        if lacks and any(env.client is not None for env in lacking):  # It may be empty.
            own = []
        limit = rng.choice([math.inf, 1, 2, 3, 5, *own])
        on_done = rng.random() < 0.7
        context = self.group.auto_reset(limit, on_done)
        if self.context is not None:
            with self.expected(RuntimeError, "a nested auto_reset"):
                context.__enter__()
            return
        if limit is None and lacks:
            with self.expected(ValueError, "an auto_reset without a limit"):
                context.__enter__()
            return
        context.__enter__()
        self.context, self.model.context = context, Context(limit, on_done)

    async def op_leave(self, rng: Random) -> None:
        if self.context is None or self.nested:
            return
        self.leave()
        if rng.random() < 0.5:  # What a step outside did to limits shows in the next context.
            await self.op_step(rng)
            await self.op_enter(rng)
            await self.op_step(rng)

    def leave(self) -> None:
        self.context.__exit__(None, None, None)
        self.context = self.model.context = None
        for env in self.model.envs.values():
            for state in (env.state, *env.loose, *env.torn):
                state.cut, state.forgotten = False, True

    # -- operations: calls and handles

    async def op_call(self, rng: Random) -> None:
        envs = self.model.idle()
        if not envs:
            return
        env, token = rng.choice(envs), rng.randrange(TOKENS)
        if env.client is not None:
            with self.expected(NotImplementedError, "a call of a client's method"):
                await self.done(self.group[env.env_id].call("peek", token))
        elif "raise" in self.features and rng.random() < 0.3:
            await self.call_fault(env, "raise", token)
        elif "die" in self.features and env.host.mortal and self.plan(env).placement != "loop":
            await self.call_fault(env, rng.choice(["plain", *DYING]), token)
        else:
            await self.peek(env, token)

    async def peek(self, env: Env, token: int) -> None:
        """Ask an env for its state."""
        handle = self.group[env.env_id]
        await self.answer_one(
            env,
            Request("call"),
            lambda: handle.call("peek", token),
            lambda value: self.take_value(env, value, token),
        )

    async def call_fault(self, env: Env, effect: str, token: int) -> None:
        """Call a method that may not return."""
        request = Request("call")
        if effect in DYING:
            env.host.ask()
            env.deadly = True
        call = self.group[env.env_id].call

        def take(value: Any) -> None:
            require(value is None and effect == "plain", "a value of a call that fails", value)
            env.request = None

        await self.answer_one(env, request, lambda: call("fault", effect, token), take)

    def take_value(self, env: Env, value: Any, token: int) -> None:
        """Compare the value of `peek`."""
        words, echo = value
        env.request = None
        shown = [tuple(one) for one in words]
        possible = [[tuple(w) for w in state.scripts.words] for state in env.possible()]
        require(shown in possible, "another state", shown, possible)
        require(tuple(echo) == (token,), "another call's arguments", echo)

    async def op_mark(self, rng: Random) -> None:
        envs = self.local(self.model.idle())
        if not envs:
            return
        env = rng.choice(envs)
        await self.mark(env, rng.choice([rng.randrange(SLOW), UNCLOSABLE, *self.marks(env)]))

    def marks(self, env: Env) -> list[int]:
        """Those that matter when its state is loaded."""
        may_die = "die" in self.features and self.is_killable(env)
        # A next worker that loads such a state would die of what nobody asked for.
        return [SLOW, UNLOADABLE] + [DEADLY] * (may_die and not env.host.renewed)

    async def mark(self, env: Env, mark: int) -> None:
        """Set the `mark` of an env, and get it."""
        if mark == UNCLOSABLE:  # Its state may be put into any other.
            self.unclosable |= {one.env_id for one in self.model.envs.values()}
        handle = self.group[env.env_id]

        def take(_: Any) -> None:
            env.request = None
            for state in (env.state, *env.loose, *env.torn):
                for sub in state.scripts.subs:
                    sub.mark = mark

        def take_mark(value: Any) -> None:
            env.request = None
            possible = [state.scripts.subs[0].mark for state in env.possible()]
            require(value in possible, "another attribute", value, mark)

        request = Request("call")
        try:
            answered = await self.answer_one(
                env, request, lambda: handle.set_attr("mark", mark), take
            )
        except (asyncio.CancelledError, KeyboardInterrupt):
            env.loose += [state.marked(mark) for state in (env.state, *env.loose)]
            raise
        if answered and env.idle:
            request = Request("call")
            await self.answer_one(env, request, lambda: handle.get_attr("mark"), take_mark)

    async def op_handle(self, rng: Random) -> None:
        envs = self.ready()
        if not envs:
            return
        env = rng.choice(envs)
        handle = self.group[env.env_id]
        if rng.random() < 0.3:
            seed = rng.choice([None, rng.randrange(1000)])
            request = Request("reset", seed=seed)
            call = lambda: handle.reset(seed)  # noqa: E731
        else:
            acts = self.acts(rng, env)
            action = action_of(env, acts)
            request = Request("step", acts=acts)
            call = lambda: handle.step(action)  # noqa: E731
        await self.answer_one(env, request, call, lambda ret: self.take_ret(env, ret, request))

    def take_ret(self, env: Env, ret: Any, request: Request) -> None:
        row = row_of_ret(env.entry, ret)
        self.say(f"   {_shown(row)}")
        self.model.take([row], request.owner)

    async def op_episode(self, rng: Random) -> None:
        """Play an episode as an agent that is one coroutine."""
        envs = self.local(self.model.idle())
        if not envs or not self.is_async:
            return
        env = rng.choice(envs)
        self.nested.add(env.env_id)
        try:
            await self.episode(rng, env)
        finally:
            self.nested.discard(env.env_id)

    async def episode(self, rng: Random, env: Env) -> None:
        request = Request("reset", seed=rng.randrange(1000))
        episode = self.group.episode(env.env_id, seed=request.seed)

        def take(ret: Any) -> None:
            self.take_ret(env, ret, request)

        async def begin() -> Any:
            return (await episode.__aenter__()).last

        async def step(action: Any) -> Any:
            before = episode.last
            try:
                return await episode.step(action)
            except EpisodeLost as lost:
                self.count(lost)
                require(episode.last is before, "what the lost step left is not the last result")
                return lost.results.values()[0]

        if not await self.answer({env.env_id: request}, begin, take):
            return
        for _ in range(rng.randint(0, 3)):
            if episode.lost or (episode.is_over and self.model.context is None):
                break
            acts = self.acts(rng, env)
            action, request = action_of(env, acts), Request("step", acts=acts)
            if not await self.answer({env.env_id: request}, partial(step, action), take):
                break
        await episode.__aexit__(None, None, None)

    # -- operations: states

    async def op_snapshot(self, rng: Random) -> None:
        await self.prepare(rng)
        lent = [env.env_id for env in self.model.idle() if env.client is not None]
        if lent and rng.random() < 0.3:
            with self.expected(NotImplementedError, "a snapshot of clients"):
                await self.done(self.group.snapshot(lent))
        envs = self.some(rng, self.local(self.ready()))
        if not envs:
            return
        states = [(env, [state.copy() for state in env.possible()]) for env in envs]
        requests = {env.env_id: Request("call") for env in envs}

        def take(data: bytes) -> None:
            for env in envs:
                env.request = None
            # A replacement goes on past a limit, and nothing shows which of the two has answered.
            if not any(env.may_be_lost and env.state.cut for env in envs):
                self.snapshots.append((data, states))
                del self.snapshots[:-4]

        try:
            await self.answer(requests, lambda: self.group.snapshot([*requests]), take)
        except SnapshotError as error:
            self.count(error)
            require(any(env.may_be_lost or env.lost for env in envs), "no state", repr(error))
            for env in envs:
                env.request = None
        for env in envs:
            env.state.refuses = False

    async def prepare(self, rng: Random) -> None:
        """Do to an env what matters to its state."""
        if (envs := self.local(self.ready())) and rng.random() < 0.5:
            env = rng.choice(envs)
            await self.mark(env, rng.choice(self.marks(env)))
        if "die" in self.features and rng.random() < 0.3:
            env = self.kill_soon(rng, self.local(self.ready()))
            await self.notice(rng, env)

    async def notice(self, rng: Random, env: Env | None) -> None:
        """Do what may let the group see that an env's worker has died."""
        kind = rng.choice(["step", "rest", "call"])
        if kind == "step":
            await self.op_step(rng)
        elif kind == "call" and env is not None and env.idle:
            await self.peek(env, 0)
        else:
            await self.rest()

    async def op_restore(self, rng: Random) -> None:
        if not self.snapshots or rng.random() < 0.3:
            await self.op_snapshot(rng)
        if not self.snapshots:
            return
        data, states = self.snapshots[-1] if rng.random() < 0.5 else rng.choice(self.snapshots)
        source = None
        if rng.random() < 0.3:
            source, states = self.branched(rng, states)
        envs = self.targets(rng, [env for env, _ in states])
        if not all(env.idle for env in envs):
            await self.op_collect(rng)
            return
        if source is None and len(states) < len(self.local(self.envs)) and rng.random() < 0.1:
            with self.expected(SnapshotError, "a snapshot of fewer envs"):
                await self.done(self.group.restore(data))
            return
        await self.prepare_restore(rng, envs)
        requests: dict[str, Request] = {}
        for env, (_, saved) in zip(envs, states, strict=True):
            requests[env.env_id] = Request("restore", saved=saved)
            if saved[0].scripts.subs[0].mark == DEADLY:
                env.host.ask()
                env.deadly = True
        await self.restore(data, requests, source)
        # Up to a limit, of which a restored env may have reached a part.
        for _ in range(rng.randint(0, 4)):
            if ready := [env for env in self.ready() if env in envs]:
                await self.step_on(ready)

    def branched(
        self, rng: Random, states: list[tuple[Env, list[State]]]
    ) -> tuple[str, list[tuple[Env, list[State]]]]:
        """The id of an env, and its state for some envs of its entry."""
        source, saved = rng.choice(states)
        same = [env for env in self.model.envs.values() if env.entry is source.entry]
        chosen = same if rng.random() < 0.5 else rng.sample(same, rng.randint(1, len(same)))
        return source.env_id, [(env, saved) for env in chosen]

    async def prepare_restore(self, rng: Random, envs: list[Env]) -> None:
        """Do what matters to the envs of a snapshot, and to their limits."""
        if "auto_reset" in self.features and self.context is None and rng.random() < 0.3:
            await self.op_enter(rng)
        if "die" in self.features and rng.random() < 0.3:
            self.kill_soon(rng, envs)

    async def restore(self, data: bytes, requests: dict[str, Request], source: str | None) -> None:
        """Put envs into the states of a snapshot, or all of them into that of `source`."""
        ids: list[str] | None = [*requests]
        if source is not None:
            entry = self.model.envs[source].entry
            if ids == [env.env_id for env in self.envs if env.entry is entry]:
                ids = None

        def take(found: Any) -> None:
            batch, flags = found
            require(flags == [False] * len(requests), "flags", flags)
            require(batch.env_ids() == [*requests], "another order", batch.env_ids())
            self.take(batch, flags, self.owner_of(requests))

        await self.answer(requests, lambda: self.group.restore(data, ids, source=source), take)

    def targets(self, rng: Random, envs: list[Env]) -> list[Env]:
        """Where the states of these envs may go: there, or to others of the same entries."""
        if rng.random() < 0.6:
            return envs
        found: list[Env] = []
        for env in envs:
            others = [
                one
                for one in self.model.envs.values()
                if one.entry is env.entry and one not in found
            ]
            found.append(rng.choice(others))
        return found

    # -- operations: calls that are given up, and calls at the same time

    WAITING = ("step", "collect", "reset", "call", "snapshot", "restore", "handle")

    def waiting(self, rng: Random, *more: str) -> Coroutine[Any, Any, None]:
        """An operation that waits."""
        names = [name for name in (*self.WAITING, *more) if name in self.allowed()]
        weights = [OPS[name][0] for name in names]
        return getattr(self, f"op_{rng.choices(names, weights)[0]}")(rng)

    def allowed(self) -> list[str]:
        return [n for n, (_, needs) in OPS.items() if needs is None or needs in self.features]

    async def op_cancel(self, rng: Random) -> None:
        if not self.is_async:
            return
        self.is_stopped = True
        task = asyncio.create_task(self.waiting(rng))
        seconds = rng.choice([0, 0, 1e-6, 1e-5, 1e-4, 1e-2])
        for _ in range(rng.randint(1, 6)):
            await asyncio.sleep(seconds)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        self.is_stopped = False

    async def op_expire(self, rng: Random) -> None:
        if not self.is_async:
            return
        seconds = 10 ** rng.uniform(-6, -0.5)
        self.is_stopped = True
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self.waiting(rng)
        self.is_stopped = False

    async def op_abort(self, rng: Random) -> None:
        """End what some envs are doing, unless that may stay with them."""
        envs = [env for env in self.model.pending(COLLECTOR) if self.is_abortable(env)]
        if not envs or not self.may_abort():
            return
        envs = self.some(rng, envs)
        ids = [env.env_id for env in envs]
        try:
            await self.done(self.group.abort(ids))
        except KeyboardInterrupt:
            await self.done(self.group.abort(ids))
            raise
        finally:
            self.note_aborted(envs)

    async def op_drain(self, rng: Random) -> None:
        """Take what is in flight, and end what is late."""
        pending = self.model.pending()
        if not self.may_abort() or not all(map(self.is_abortable, pending)):
            return
        deadline = rng.choice([None, 1e-4, 0.2])
        ends = deadline is not None
        try:
            found, flags = await self.done(self.group.drain(deadline))
        except EnvFault as fault:
            self.note_faults(fault)
            self.model.failed(fault, COLLECTOR)
            if fault.results is not None and len(fault.results):
                self.take(fault.results, None, COLLECTOR)
        except KeyboardInterrupt:
            ends = True
            await self.done(self.group.abort())
            raise
        else:
            if len(found):
                self.take(found, flags, COLLECTOR)
        finally:
            envs = self.model.envs.values() if ends else ()
            self.note_aborted([env for env in envs if env.limbo or env.request is not None])

    def may_abort(self) -> bool:
        """No other call waits, and an abort leaves nothing behind that the model must guess."""
        guessed = self.features & {"raise", "hang", "snapshots"} or self.was_interrupted
        return not (self.tasks or self.collecting or guessed)

    def is_abortable(self, env: Env) -> bool:
        """No request to it leaves anything behind that its results don't show."""
        assert env.request is not None
        effects = [effect for effect, _ in env.request.acts]
        grudges = [sub.grudge for sub in env.state.scripts.subs]
        later = [e for e in effects if e.endswith(" next") or e == "keep state"]
        later += ["rubbish"] * ("rubbish" in effects and env.entry.on_error == "restart")
        return not (later or any(grudges))

    def note_aborted(self, envs: Iterable[Env]) -> None:
        """Their errors stay for a collect, but the envs are free."""
        pending = self.group.pending
        for env in envs:
            if env.env_id not in pending:
                self.model.abort(env)

    async def op_task(self, rng: Random) -> None:
        if not self.is_async or len(self.tasks) > 3:
            return
        self.tasks.append(asyncio.create_task(self.waiting(rng, "episode")))
        await asyncio.sleep(0)

    async def op_join(self, rng: Random) -> None:
        """Let all tasks end; a collect only if it can."""
        if self.tasks:
            await self.look_at_tasks(wait=True)

    # -- operations: misuse, looking, killing

    async def op_misuse(self, rng: Random) -> None:
        """What is refused changes nothing."""
        envs = self.some(rng, self.local(self.ready()))
        if not envs:
            return
        batch, _ = self.response(rng, envs)
        ids, values = list(batch.env_ids()), list(batch.values())
        # Of some, the results are handed out a little earlier; see `check_pending`.
        known = [one for one in self.model.pending() if one.env_id not in self.nested]
        busy = [one for one in self.local(known) if not self.is_lost(one)]
        sized = ("vector", "single", "digits", "number")
        fits = [k for k, i in enumerate(ids) if self.model.envs[i].entry.controls in sized]
        kinds = ["unknown", "double", "count"] + ["shape"] * bool(fits)
        kind = rng.choice(kinds + ["busy"] * bool(busy) + ["foreign", "seed"] * (len(ids) > 1))
        wrong: Any = EnvBusy
        if kind == "unknown":
            ids.append("nobody-7")
            values.append(PolicyResponse("nobody-7", values[0].action))
            wrong = UnknownEnv
        elif kind == "double":
            ids.append(ids[0])
            values.append(values[0])
        elif kind == "foreign":
            ids[0], ids[1] = ids[1], ids[0]
            wrong = BadAction
        elif kind == "seed":
            seeds = dict.fromkeys(ids, 3)
            with self.expected(ValueError, "a seed of an env that is not reset"):
                self.group.reset_async(seeds, env_ids=ids[1:])
            return
        elif kind == "busy":
            env = rng.choice(busy)  # Its error may have been read, but it was not collected.
            ids.append(env.env_id)
            values.append(PolicyResponse(env.env_id, action_of(env, self.acts(rng, env))))
            for call in (
                lambda: self.group.step_async(BatchedData(ids, values)),
                lambda: self.group.reset_async(env_ids=ids),
            ):
                with self.expected(EnvBusy, kind):
                    call()
            return
        elif kind == "shape":
            values[fits[0]] = PolicyResponse(ids[fits[0]], np.zeros((3, 3, 7)))
            wrong = BadAction
        else:
            with self.expected(BadAction, "columns of another length"):
                batch.respond(action=[0] * (len(batch) + 1))
            return
        limbo = any(env.limbo and env.host.mortal for env in envs)
        with self.expected((wrong, WorkerDied, *[EnvBusy] * limbo), kind):
            self.step_wrongly(BatchedData(ids, values))

    def step_wrongly(self, batch: BatchedData) -> None:
        try:
            self.group.step_async(batch)
        except WorkerDied as fault:  # Of an env that was lost before.
            for env_id in fault.env_ids:
                self.model.died(self.model.envs[env_id], fault)
            raise

    async def op_look(self, rng: Random) -> None:
        """What is asked of a group without waiting."""
        pending = {env.env_id for env in self.model.pending()}
        limbo = {env.env_id for env in self.model.envs.values() if env.limbo}
        for worker in self.group.get_workers():
            require(set(worker["owed"]) <= pending | limbo, "owed", worker, pending)
        self.check_stats()
        self.group.get_stats()
        numbers = self.group.metrics(by_entry=True)
        require(not any(map(math.isnan, numbers.values())), "numbers", numbers)
        there = [numbers[f"envs/{state}"] for state in ("idle", "busy", "uncollected")]
        require(min(there) >= 0 and sum(there) == numbers["envs/envs"], "numbers", numbers)
        if self.batches and rng.random() < 0.3:
            batch = self.batches[-1]
            twin = pickle.loads(pickle.dumps(batch))
            require(twin.env_ids() == batch.env_ids(), "a pickled batch")
            require(
                same(twin.reward, batch.reward) if not self.program.plans[1:] else True,
                "its rewards",
            )

    async def op_trace(self, rng: Random) -> None:
        if self.trace is not None:
            self.stop_trace()
            return
        self.trace = tempfile.TemporaryDirectory()
        self.tracing = self.group.trace(Path(self.trace.name) / "run.json")
        self.tracing.start()

    def stop_trace(self) -> None:
        if self.trace is not None:
            self.tracing.stop()
            self.trace.cleanup()
            self.trace = None


def ids_of(fault: EnvFault) -> Sequence[str]:
    """The envs whose requests an error answers."""
    return getattr(fault, "env_ids", ()) or (fault.env_id,)


def _shown(row: Row) -> str:
    words = " ".join(",".join(map(str, one)) for one in row.words)
    marks = [
        name
        for name, column in (
            ("end", row.terminated), ("cut", row.truncated), ("reset", row.resets),
            ("limit", row.limit), ("restarted", row.restarted),
        )
        if column is not None and any(column)
    ]  # fmt: skip
    return " ".join([row.env_id, words, *marks])
