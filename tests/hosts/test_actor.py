"""Actors without Ray: batches of requests in, columns and errors out."""

from __future__ import annotations

import pickle
from typing import TYPE_CHECKING, Any

import numpy as np
from group.sample_envs import Probe

from rlightning_aio import EnvConfig
from rlightning_aio._core.hosts.completion_frames import completion_in
from rlightning_aio._core.hosts.messages import Built, NotBuilt, Raised, Result, StartOrder, Value
from rlightning_aio._core.hosts.ray.actor import Batch, EnvActor
from rlightning_aio.protocol.entries import Operation, entry
from rlightning_aio.protocol.pickling import dumped_with_code

if TYPE_CHECKING:
    import pytest

    from rlightning_aio._core.hosts.messages import Completion
    from rlightning_aio._core.hosts.ray.actor import Reply

HOST_ID, FIRST_SLOT = 3, 5


def order(num_envs: int = 2, **fields: Any) -> bytes:
    config = EnvConfig(
        **{"name": "one", "backend": "probe", "task": "-", "num_workers": num_envs, **fields}
    )
    indices, fns = tuple(range(num_envs)), (None,) * num_envs
    return dumped_with_code(StartOrder(config, None, indices, fns, spins=False))


def actor(**fields: Any) -> EnvActor:
    made = EnvActor(FIRST_SLOT, [])
    built = completion_in(HOST_ID, made.build(order(**fields)))
    assert isinstance(built, Built)
    assert [env.meta.env_id for env in built.started] == ["one-0", "one-1"]
    return made


def steps(actions: list[list[float]]) -> Batch:
    entries = [entry(1, FIRST_SLOT + k, Operation.STEP) for k in range(len(actions))]
    return Batch(np.array(entries, np.int64), [np.array(actions, float)], None)


def completions(reply: Reply) -> list[Completion]:
    return [completion_in(HOST_ID, frame) for frame in reply.frames]


def rewards(reply: Reply) -> list[float]:
    return reply.columns[1].tolist()


def test_an_error_concerns_one_env_only() -> None:
    """The results of the others are in the columns, in the order of their entries."""
    batch = steps([[Probe.RAISE, 1], [0, 2]])
    reply = actor().execute(batch)
    assert reply.with_rows().tolist() == [batch.entries[1]]
    assert rewards(reply) == [2]
    (raised,) = (one for one in completions(reply) if isinstance(one, Raised))
    assert raised.entry == batch.entries[0]
    assert "OddError" in raised.error.summary


def test_arguments_may_be_out_of_band() -> None:
    """A value of a call is not a result; if it can't be pickled, only that call fails."""
    made = actor()
    made._runners[1].env.generator = (each for each in ())  # pyright: ignore[reportAttributeAccessIssue]
    calls = [("double", (4,), {}), ("__getattribute__", ("generator",), {})]
    entries = [entry(2, FIRST_SLOT, Operation.CALL), entry(3, FIRST_SLOT + 1, Operation.CALL)]
    reply = made.execute(Batch(np.array(entries), [], [pickle.dumps(call) for call in calls]))
    value, raised = completions(reply)
    assert value == Value(HOST_ID, entries[0], 8)
    assert isinstance(raised, Raised)
    assert "what it returned can't be pickled" in raised.error.text
    assert not reply.columns
    reset = entry(4, FIRST_SLOT, Operation.RESET)
    given = pickle.dumps((6, {"nested": [1]}))
    reply = made.execute(Batch(np.array([reset]), [], [given]))
    result = completions(reply)[-1]
    assert isinstance(result, Result)
    assert result.entry == reset
    assert isinstance(result.out_of_band, bytes)
    assert pickle.loads(result.out_of_band)["info"] == {"options": {"nested": [1]}}
    assert reply.columns[0].tolist() == [[0, 1, 0, 6]]


def test_an_env_that_cannot_be_built_is_reported_by_index() -> None:
    """An order that can't be unpickled is reported, too."""
    made = EnvActor(FIRST_SLOT, [])
    failure = completion_in(HOST_ID, made.build(order(env_kwargs={"fails": 1})))
    assert isinstance(failure, NotBuilt)
    assert (failure.env_index, failure.error.summary) == (1, "RuntimeError: no simulator here")
    unreadable = EnvActor(FIRST_SLOT, []).build(b"cnot_there\nEnv\n.")
    failure = completion_in(HOST_ID, unreadable)
    assert isinstance(failure, NotBuilt)
    assert "not_there" in failure.error.summary


def test_all_envs_are_closed_even_if_one_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each is closed once, and errors are reported by index."""

    def close(env: Probe) -> None:
        raise ValueError(f"stuck at {env.worker_index}")

    made = actor()
    monkeypatch.setattr(Probe, "close", close)
    errors = [(index, error.summary) for index, error in made.close()]
    assert errors == [(k, f"ValueError: stuck at {k}") for k in range(2)]
