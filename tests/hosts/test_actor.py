"""What an actor does, without Ray: batches in, columns and words out."""

from __future__ import annotations

import pickle
import threading
from typing import TYPE_CHECKING, Any

import numpy as np
from group.sample_envs import Gate, Probe

from rlightning_aio import EnvConfig
from rlightning_aio.hosts.actor import Batch, EnvActor, NotStarted
from rlightning_aio.hosts.messages import StartOrder
from rlightning_aio.hosts.pickling import dumped_with_code
from rlightning_aio.protocol.entries import Operation, entry

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from rlightning_aio.hosts.actor import Reply

FIRST_SLOT = 5


def order(num_envs: int = 2, **fields: Any) -> bytes:
    config = EnvConfig(
        **{"name": "one", "backend": "probe", "task": "-", "num_workers": num_envs, **fields}
    )
    indices, fns = tuple(range(num_envs)), (None,) * num_envs
    return dumped_with_code(StartOrder(config, None, indices, fns, spins=False, core=None))


def actor(limits: dict[int, float] | None = None, **fields: Any) -> EnvActor:
    made = EnvActor(FIRST_SLOT, limits or {}, [])
    started = made.build(order(**fields))
    assert isinstance(started, bytes)
    assert [env.meta.env_id for env in pickle.loads(started)] == ["one-0", "one-1"]
    return made


def steps(actions: list[list[float]]) -> Batch:
    entries = [entry(1, FIRST_SLOT + k, Operation.STEP) for k in range(len(actions))]
    return Batch(np.array(entries, np.int64), [np.array(actions, float)], None)


def rewards(reply: Reply) -> list[float]:
    return reply.columns[1].tolist()


def test_an_error_is_one_envs_alone() -> None:
    """The others' results are in the columns, in the order of the entries that are done."""
    batch = steps([[Probe.RAISE, 1], [0, 2]])
    reply = actor().execute(batch)
    assert reply.with_rows().tolist() == [batch.entries[1]]
    assert rewards(reply) == [2]
    ((failed, error),) = reply.errors
    assert failed == batch.entries[0]
    assert "OddError" in error.summary
    assert not reply.values


def test_arguments_may_come_out_of_band() -> None:
    """A call's value is no result; a value that no pickle takes is that call's error."""
    made = actor()
    calls = [("double", (4,), {}), ("__getattribute__", ("_preprocess_fn",), {})]
    entries = [entry(2, FIRST_SLOT, Operation.CALL), entry(3, FIRST_SLOT + 1, Operation.CALL)]
    reply = made.execute(Batch(np.array(entries), [], [pickle.dumps(call) for call in calls]))
    assert next((e, pickle.loads(packed)) for e, packed in reply.values) == (entries[0], 8)
    assert not reply.columns
    reset = entry(4, FIRST_SLOT, Operation.RESET)
    given = pickle.dumps((6, {"nested": [1]}))
    reply = made.execute(Batch(np.array([reset]), [], [given]))
    ((told, beside),) = reply.beside
    assert told == reset
    assert pickle.loads(beside)["info"] == {"options": {"nested": [1]}}
    assert reply.columns[0].tolist() == [[0, 1, 0, 6]]


def test_an_env_that_cannot_be_built_is_told_by_its_index() -> None:
    """So is an order that this place can't read."""
    made = EnvActor(FIRST_SLOT, {}, [])
    told = made.build(order(env_kwargs={"fails": 1}))
    assert isinstance(told, NotStarted)
    assert (told.env_index, told.error.summary) == (1, "RuntimeError: no simulator here")
    told = EnvActor(FIRST_SLOT, {}, []).build(b"cnot_there\nEnv\n.")
    assert isinstance(told, NotStarted)
    assert "not_there" in told.error.summary


def test_a_request_that_takes_too_long_is_told_with_stacks(tmp_path: Path) -> None:
    """Which, for how long, and what it was doing; what has no limit may take its time."""
    gate = Gate(str(tmp_path), "one-1").make()
    made = actor({Operation.STEP: 0.05}, backend="gated", env_kwargs={"gates": str(tmp_path)})
    reset = entry(1, FIRST_SLOT, Operation.RESET)
    made.execute(Batch(np.array([reset]), [np.zeros(1, np.int64)], None))
    request = entry(2, FIRST_SLOT + 1, Operation.STEP)
    stepping = threading.Thread(
        target=made.execute, args=[Batch(np.array([request]), [np.zeros((1, 2))], None)]
    )
    stepping.start()
    late = made.watch()
    gate.open()
    stepping.join()
    assert late.entry == request
    assert late.taken_ns >= 0.05e9
    assert "wait_at_gate" in late.stacks


def test_envs_are_closed_whatever_another_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of them once, and told by index."""

    def close(env: Probe) -> None:
        raise ValueError(f"stuck at {env.worker_index}")

    made = actor()
    monkeypatch.setattr(Probe, "close", close)
    told = [(index, error.summary) for index, error in made.close()]
    assert told == [(k, f"ValueError: stuck at {k}") for k in range(2)]
