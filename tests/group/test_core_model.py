"""Random use of the core compared with a naive model: each request is answered exactly once."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from group.fake_host import (
    PLAIN,
    RAISES,
    SENDS_INFO,
    TERMINATES,
    TRUNCATES,
    FakeEnv,
    FakeGroup,
    FakeWorker,
)
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from rlightning_aio.batch import BatchedData
from rlightning_aio.errors import (
    BadAction,
    EnvBusy,
    EnvRaised,
    NothingPending,
    RLightningError,
    UnknownEnv,
    WorkerDied,
)
from rlightning_aio.group.wait import CollectRules
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from group.fake_host import Running

pytestmark = pytest.mark.usefixtures("implementation")

ACTIONS = st.sampled_from((PLAIN, PLAIN, PLAIN, TERMINATES, TRUNCATES, RAISES, SENDS_INFO))


@dataclass
class Answer:
    """The expected answer to a request; `error` if it raises."""

    observation: tuple[float, ...] = ()
    reward: float = 0.0
    terminated: bool = False
    truncated: bool = False
    info: dict[str, Any] = field(default_factory=dict)
    over: bool = False
    error: bool = False


@dataclass
class Request:
    """The model's view of a request.

    Attributes:
        op: ``step``, ``reset`` or ``call``; a step that auto-reset replaces is a ``reset``.
        owner: the operation that waits for it; None for `collect_async`.
        restarts: its worker died before it replied; at_fault: the env that was being executed.
        value: the extra that was attached to the step.
    """

    op: str
    action: int = PLAIN
    value: int | None = None
    seed: int | None = None
    owner: Running | None = None
    answer: Answer | None = None
    restarts: bool = False
    at_fault: str | None = None
    abandoned: bool = False


@dataclass
class ModelEnv:
    """The model's view of one env.

    Attributes:
        count: number of steps since the last reset.
        cut: its last result reached the limit of auto-reset; ended: the episode ended by itself.
        lost: its worker died, which no result has told; at_fault: the env that was being executed.
    """

    env: FakeEnv
    request: Request | None = None
    count: int = 0
    cut: bool = False
    ended: bool = False
    over: bool = False
    lost: bool = False
    at_fault: str | None = None

    def owes(self) -> bool:
        return self.request is not None and self.request.answer is None


@dataclass
class Collector:
    """A collect in progress, by the rules of the contract."""

    running: Running
    timeout: float | None
    wait_all: bool
    min_results: int
    max_results: int | None
    end: float | None
    window: float | None = None


class CoreMachine(RuleBasedStateMachine):
    """Each rule acts on the core and on the model; invariants compare them."""

    @initialize(
        rows=st.lists(st.integers(1, 3), min_size=1, max_size=3),
        inline=st.lists(st.sampled_from((False, False, True)), min_size=3, max_size=3),
        reads_extras=st.lists(st.booleans(), min_size=3, max_size=3),
        limit=st.integers(1, 4),
    )
    def start(
        self, rows: list[int], inline: list[bool], reads_extras: list[bool], limit: int
    ) -> None:
        self.group = FakeGroup(
            rows, inline, reads_extras, max_episode_steps=limit, max_restarts=10**6
        )
        self.core = self.group.core
        self.group.expect_ordinary_steps()
        self.envs = [ModelEnv(FakeEnv(slot)) for slot in range(sum(rows))]
        self.operations: list[tuple[Running, list[int], list[Request]]] = []
        self.collector: Collector | None = None
        self.fault_queue = 0
        self.limit: int | None = None
        self.on_done = True
        self.last_batch: BatchedData | None = None

    def teardown(self) -> None:
        if hasattr(self, "group"):
            self.group.close()

    # -- drawing

    def idle(self) -> list[int]:
        return [slot for slot, env in enumerate(self.envs) if env.request is None]

    def some(self, data: st.DataObject, slots: list[int]) -> list[int]:
        return data.draw(st.lists(st.sampled_from(slots), min_size=1, unique=True))

    def responses(self, data: st.DataObject, slots: list[int]) -> tuple[BatchedData, list[int]]:
        """Return a batch for `slots`, made of columns if the last batch has exactly these."""
        actions = [data.draw(ACTIONS) for _ in slots]
        last = self.last_batch
        self.attaches = True
        if last is not None and [self.slot(id_) for id_ in last.ids()] == slots:
            return last.respond(np.array(actions), value=np.array(slots)), actions
        ids = [self.group.env_ids[slot] for slot in slots]
        self.attaches = data.draw(st.booleans())
        extras = [{"value": slot} if self.attaches else {} for slot in slots]
        values = [
            PolicyResponse(i, a, **own) for i, a, own in zip(ids, actions, extras, strict=True)
        ]
        return BatchedData(ids, values), actions

    @staticmethod
    def slot(env_id: str) -> int:
        return int(env_id.removeprefix("fake-"))

    def requests_for(self, slots: list[int], actions: list[int]) -> list[Request]:
        """Record steps of `slots` in the model."""
        requests: list[Request] = []
        for slot, action in zip(slots, actions, strict=True):
            env = self.envs[slot]
            value = slot if self.attaches else None
            request = Request("step", action, value)
            if self.limit is not None and (env.cut or (self.on_done and env.ended)):
                request = Request("reset", value=value)
            if env.lost:
                request = Request("reset", value=value, restarts=True, at_fault=env.at_fault)
                env.lost = False
            env.request = request
            requests.append(request)
            self.run_if_inline(slot)
        return requests

    # -- what envs do

    def run_if_inline(self, slot: int) -> None:
        """Execute inline requests if a call waits; see `settle`."""

    def execute(self, slot: int) -> None:
        """Execute a request in the model's env."""
        model = self.envs[slot]
        request, env = model.request, model.env
        assert request is not None
        assert request.answer is None
        if request.op == "call":
            request.answer = Answer(error=request.action == RAISES)
            return
        if request.op == "reset":
            env.reset()
            model.over = False
            request.answer = Answer(tuple(env.observation()))
            if request.seed is not None:
                request.answer.info = {"seed": [request.seed]}
        elif request.action == RAISES:
            request.answer = Answer(error=True)
            if request.owner is None:
                self.fault_queue += 1
                model.request = None
            return
        else:
            env.step()
            model.over |= request.action in (TERMINATES, TRUNCATES)
            info = {"steps": [env.steps]} if request.action == SENDS_INFO else {}
            request.answer = Answer(
                tuple(env.observation()),
                float(request.action),
                request.action == TERMINATES,
                request.action == TRUNCATES,
                info,
                over=model.over,
            )
        if request.restarts:
            request.answer.truncated = True
            request.answer.info["worker_restarted"] = "was killed by SIGKILL"
            if request.at_fault is not None:
                request.answer.info["env_at_fault"] = request.at_fault

    def waits(self) -> bool:
        return bool(self.operations) or self.collector is not None

    def run_inline(self) -> None:
        """Run the model's inline hosts, as a waiting call runs those of the core."""
        for host in self.group.hosts:
            if not host.inline:
                continue
            waiting = {host.first_slot + row for row, _ in host.waiting}
            for slot in range(host.first_slot, host.first_slot + host.num_envs):
                request = self.envs[slot].request
                if request is not None and request.answer is None and slot not in waiting:
                    self.execute(slot)
                    if request.abandoned:
                        self.envs[slot].request = None

    # -- requests

    @precondition(lambda self: self.idle())
    @rule(data=st.data())
    def step_async(self, data: st.DataObject) -> None:
        slots = self.some(data, self.idle())
        batch, actions = self.responses(data, slots)
        self.group.steps.step_async(batch, self.group.now)
        self.requests_for(slots, actions)
        self.group.turn()
        self.settle()

    @precondition(lambda self: self.idle())
    @rule(data=st.data())
    def step(self, data: st.DataObject) -> None:
        slots = self.some(data, self.idle())
        batch, actions = self.responses(data, slots)
        requests = self.requests_for(slots, actions)
        self.operate(self.group.steps.step(batch, self.group.now), slots, requests)

    @precondition(lambda self: self.idle())
    @rule(data=st.data(), seeds=st.sampled_from(("none", "int", "list", "mapping")))
    def reset(self, data: st.DataObject, seeds: str) -> None:
        slots = self.some(data, self.idle())
        ids = [self.group.env_ids[slot] for slot in slots]
        seed: Any = None
        expected: list[int | None] = [None] * len(slots)
        if seeds == "int":
            seed = 100
            expected = [100 + slot for slot in slots]
        elif seeds == "list":
            seed = [200 + 7 * k for k in range(len(slots))]
            expected = list(seed)
        elif seeds == "mapping":
            seed = {ids[0]: 300}
            expected[0] = 300
        requests = [Request("reset", seed=one) for one in expected]
        for slot, request in zip(slots, requests, strict=True):
            self.envs[slot].request = request
            self.envs[slot].lost = False
        self.operate(self.core.reset(self.group.now, seed, None, ids), slots, requests)

    @precondition(lambda self: self.idle())
    @rule(data=st.data(), raises=st.sampled_from((False, False, True)))
    def call(self, data: st.DataObject, raises: bool) -> None:
        slot = data.draw(st.sampled_from(self.idle()))
        request = Request("call", RAISES if raises else PLAIN)
        self.envs[slot].request = request
        operation = self.core.calls.call(
            self.group.now, slot, ("raise" if raises else "who", (), {})
        )
        self.operate(operation, [slot], [request])

    def operate(self, operation: Any, slots: list[int], requests: list[Request]) -> None:
        """Begin an operation that waits for `requests`, and compare its progress."""
        running = self.group.begin(operation)
        for request in requests:
            request.owner = running
        self.operations.append((running, slots, requests))
        self.settle()

    # -- bad use changes nothing

    @rule(data=st.data())
    def refuse(self, data: st.DataObject) -> None:
        """Submit a batch with one fault; it is refused as a whole."""
        busy = [slot for slot, env in enumerate(self.envs) if env.request is not None]
        faults = ["unknown", "double", "shape", "kind"] + ["busy"] * bool(busy)
        fault = data.draw(st.sampled_from(faults))
        slots = self.some(data, self.idle()) if self.idle() else [0]
        batch, _ = self.responses(data, slots)
        ids, values = list(batch.env_ids()), list(batch.values())
        if fault == "unknown":
            ids.append("fake-99")
            values.append(PolicyResponse("fake-99", PLAIN))
        elif fault == "double":
            ids.append(ids[0])
            values.append(values[0])
        elif fault == "busy":
            ids.append(f"fake-{busy[0]}")
            values.append(PolicyResponse(ids[-1], PLAIN))
        elif self.idle():
            values[-1] = PolicyResponse(ids[-1], [PLAIN] * 2 if fault == "shape" else 0.5)
        expected: Any = {"unknown": UnknownEnv, "double": EnvBusy, "busy": EnvBusy}.get(
            fault, BadAction if self.idle() else EnvBusy
        )
        with pytest.raises(expected):
            self.group.steps.step_async(BatchedData(ids, values), self.group.now)
        self.settle()

    @precondition(lambda self: self.collector is not None)
    @rule()
    def collect_twice(self) -> None:
        """Start a second collect; it is refused and disturbs no call."""
        with pytest.raises(RLightningError, match="one collector at a time"):
            self.group.begin(self.collect_operation(None, False, 1, None, None)).result()
        self.settle()

    # -- collect

    def collect_operation(
        self,
        timeout: float | None,
        wait_all: bool,
        min_results: int,
        max_results: int | None,
        deadline: float | None,
    ) -> Any:
        return self.group.steps.collect(
            self.group.now,
            CollectRules(
                timeout=timeout,
                wait_all=wait_all,
                min_results=min_results,
                max_results=max_results,
                deadline=deadline,
            ),
        )

    @precondition(lambda self: self.collector is None)
    @rule(
        timeout=st.sampled_from((None, None, 1.0, 3.0)),
        wait_all=st.sampled_from((False, False, False, True)),
        min_results=st.integers(1, 5),
        more=st.sampled_from((None, 0, 2)),
        deadline=st.sampled_from((None, 2.0)),
    )
    def collect(
        self,
        timeout: float | None,
        wait_all: bool,
        min_results: int,
        more: int | None,
        deadline: float | None,
    ) -> None:
        most = None if more is None else min_results + more
        running = self.group.begin(
            self.collect_operation(timeout, wait_all, min_results, most, deadline)
        )
        end = None if deadline is None else self.group.now + deadline
        self.collector = Collector(
            running, None if wait_all else timeout, wait_all, min_results, most, end
        )
        self.settle()

    # -- time, replies, faults

    @precondition(lambda self: any(h.waiting and not h.inline for h in self.group.hosts))
    @rule(data=st.data(), newest_first=st.booleans())
    def finish(self, data: st.DataObject, newest_first: bool) -> None:
        """Let a worker execute a request, not necessarily the oldest."""
        slots = [
            host.first_slot + row
            for host in self.group.hosts
            if not host.inline
            for row, _ in host.waiting
        ]
        slot = data.draw(st.sampled_from(slots))
        request = self.envs[slot].request
        assert request is not None
        self.execute(slot)
        if request.abandoned:
            self.envs[slot].request = None
        self.group.finish(slot, newest_first=newest_first)
        self.settle()

    @rule(seconds=st.sampled_from((0.5, 1.0, 2.0)))
    def pass_time(self, seconds: float) -> None:
        self.group.pass_time(seconds)
        self.settle()

    def alive(self) -> list[FakeWorker]:
        return [h for h in self.group.hosts if isinstance(h, FakeWorker) and h.alive]

    @precondition(alive)
    @rule(data=st.data(), refusals=st.integers(0, 2))
    def die(self, data: st.DataObject, refusals: int) -> None:
        """Let a worker die: each of its envs that owed a reply gets one marked result.

        Requests sent before a replacement is up, which may take attempts and time, are executed by
        it.
        """
        host = data.draw(st.sampled_from(self.alive()))
        host.refusals = refusals
        slots = range(host.first_slot, host.first_slot + host.num_envs)
        # Fake workers don't say what they were executing, so the first env that owes is taken.
        at_fault = next((f"fake-{slot}" for slot in slots if self.envs[slot].owes()), None)
        for slot in slots:
            model = self.envs[slot]
            model.env = FakeEnv(slot, host.life + 1)
            model.lost, model.at_fault = True, at_fault
            request = model.request
            if request is None or request.answer is not None:
                continue
            if request.op == "call":
                request.answer = Answer(error=True)
                if request.abandoned:
                    model.request = None
            else:
                request.op, request.seed, request.restarts = "reset", None, True
                request.at_fault = at_fault
                model.lost = False
        host.die()
        self.group.wake()
        self.group.turn()
        self.settle()

    # -- giving up

    @precondition(lambda self: self.operations)
    @rule(data=st.data())
    def cancel(self, data: st.DataObject) -> None:
        """Cancel a call; a collect returns its results."""
        running, slots, requests = self.operations.pop(
            data.draw(st.integers(0, len(self.operations) - 1))
        )
        for slot, request in zip(slots, requests, strict=True):
            request.owner = None
            if request.op == "call":
                request.abandoned = True
            if request.answer is not None and (request.abandoned or request.answer.error):
                self.fault_queue += not request.abandoned
                self.envs[slot].request = None
        self.group.cancel(running)
        self.settle()

    @precondition(lambda self: self.collector is not None)
    @rule()
    def cancel_collect(self) -> None:
        assert self.collector is not None
        self.group.cancel(self.collector.running)
        self.collector = None
        self.settle()

    # -- auto-reset

    @precondition(lambda self: self.limit is None)
    @rule(limit=st.integers(1, 4), on_done=st.booleans(), own=st.booleans())
    def enter_auto_reset(self, limit: int, on_done: bool, own: bool) -> None:
        configured = self.group.config.max_episode_steps
        assert configured is not None
        self.limit = configured if own or limit == configured else limit
        if own or limit == configured:
            self.core.continuity.begin(None if own else limit, on_done=on_done)
        else:
            with pytest.warns(UserWarning, match="overrides"):
                self.core.continuity.begin(limit, on_done=on_done)
        self.on_done = on_done
        with pytest.raises(RuntimeError, match="nest"):
            self.core.continuity.begin(1, on_done=True)

    @precondition(lambda self: self.limit is not None)
    @rule()
    def leave_auto_reset(self) -> None:
        self.core.continuity.end()
        self.limit = None

    # -- comparing

    def settle(self) -> None:
        """Check that all operations that must be done are, with the right results."""
        self.run_inline()
        for entry in list(self.operations):
            self.settle_operation(*entry)
        if self.collector is not None:
            self.settle_collector(self.collector)

    def settle_operation(self, running: Running, slots: list[int], requests: list[Request]) -> None:
        done = all(request.answer is not None for request in requests)
        assert running.done == done, (running, requests)
        if not done:
            return
        self.operations.remove((running, slots, requests))
        good = [s for s, r in zip(slots, requests, strict=True) if r.answer and not r.answer.error]
        if len(good) < len(slots):
            assert isinstance(running.error, EnvRaised | WorkerDied)
            faults = (running.error, *running.error.others)
            named = [
                fault.env_ids if isinstance(fault, WorkerDied) else (fault.env_id,)
                for fault in faults
            ]
            assert {self.slot(id_) for ids in named for id_ in ids} == set(slots) - set(good)
            results = running.error.results
            assert (results is None) == (not good or requests[0].op == "call")
            if results is not None:
                self.check_batch(results, None, good)
        elif requests[0].op == "call":
            assert running.result() == (slots[0], "who", ())
        else:
            batch, flags = running.result()
            assert [self.slot(id_) for id_ in batch.ids()] == slots
            self.check_batch(batch, flags, slots)
        for slot in slots:
            self.envs[slot].request = None

    def settle_collector(self, collector: Collector) -> None:
        now, running = self.group.now, collector.running
        mine = [
            slot
            for slot, env in enumerate(self.envs)
            if env.request is not None and env.request.owner is None and not env.request.abandoned
        ]
        ready = [slot for slot in mine if (r := self.envs[slot].request) and r.answer]
        if self.fault_queue:
            self.fault_queue -= 1
            with pytest.raises(EnvRaised):
                running.result()
            self.collector = None
            return
        if not mine:
            with pytest.raises(NothingPending):
                running.result()
            self.collector = None
            return
        most = min(len(mine), collector.max_results or len(mine))
        need = most if collector.wait_all else min(collector.min_results, most)
        if ready and collector.timeout is not None and collector.window is None:
            collector.window = now + collector.timeout
        window = collector.window
        closed = window is None or now >= window or len(ready) >= most
        if len(ready) >= need and closed:
            self.collector = None
            batch, flags = running.result()
            slots = [self.slot(id_) for id_ in batch.ids()]
            assert len(slots) == min(len(ready), most)
            assert set(slots) <= set(ready)
            self.check_batch(batch, flags, slots)
            for slot in slots:
                self.envs[slot].request = None
        elif collector.end is not None and now >= collector.end:
            self.collector = None
            with pytest.raises(TimeoutError):
                running.result()
        else:
            assert not running.done, (running.value, running.error)

    def check_batch(self, batch: BatchedData, flags: list[bool] | None, slots: list[int]) -> None:
        """Compare rows, flags and counters with the model."""
        self.last_batch = batch
        assert max(Counter(slots).values()) == 1
        expected_flags: list[bool] = []
        for position, slot in enumerate(slots):
            model = self.envs[slot]
            request = model.request
            assert request is not None
            answer = request.answer
            assert answer is not None
            stepped = request.op == "step"
            assert tuple(batch.observation[position]) == answer.observation
            assert batch.reward[position] == answer.reward
            assert batch.terminated[position] == answer.terminated
            assert batch.truncated[position] == answer.truncated
            assert batch.info()[position] == answer.info
            assert batch.values()[position].env_id == f"fake-{slot}"
            model.count = model.count + 1 if stepped else 0
            reached = self.limit is not None and model.count >= self.limit
            model.cut, model.ended = reached, stepped and answer.over
            expected_flags.append(reached)
            assert batch.index[position] == slot
            assert batch.is_reset[position] == (not stepped)
            assert batch.restarted[position] == request.restarts
            assert batch.limit_reached[position] == reached
            assert batch.done[position] == (answer.terminated or answer.truncated or reached)
            if request.value is not None:
                assert batch.sent.value[position] == request.value
        if flags is not None:
            assert flags == expected_flags

    @invariant()
    def nothing_is_forgotten(self) -> None:
        """Compare the numbers of pending requests of core and model."""
        if not hasattr(self, "envs"):
            return
        mine = [
            env
            for env in self.envs
            if env.request is not None and env.request.owner is None and not env.request.abandoned
        ]
        pending = self.core.pending()
        assert self.core.requests.pending()[1] == len(mine)
        asked = {
            f"fake-{slot}"
            for slot, env in enumerate(self.envs)
            if env.request is not None and not env.request.abandoned
        }
        assert asked <= {*pending} if self.fault_queue else asked == {*pending}
        in_flight = self.core.requests.in_flight
        for host, count in zip(self.group.hosts, in_flight, strict=True):
            slots = range(host.first_slot, host.first_slot + host.num_envs)
            outstanding = [r for k in slots if (r := self.envs[k].request) is not None]
            assert count <= len(outstanding)
            assert count >= sum(r.answer is None for r in outstanding)


def test_the_core() -> None:
    """In any order of events."""
    run_state_machine_as_test(CoreMachine, settings=settings(stateful_step_count=40))
