"""The budget of unauthenticated peers, and the order in which they are admitted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st
from zmq.utils import z85

from rlightning_aio._core.hosts.env_server.authenticator import (
    Authenticator,
    Question,
    QuestionQueue,
)
from rlightning_aio._core.hosts.env_server.rate_limiter import (
    CONNECTION_COST,
    RateLimiter,
    message_cost,
)
from rlightning_aio.protocol.net.limited_log import LimitedLog
from rlightning_aio.protocol.net.wire import MAX_HELLO_BYTES
from rlightning_aio.remote.keys import make_keys, read_client_keys

if TYPE_CHECKING:
    from pathlib import Path

AMOUNTS = st.floats(0.0, 0.5)
MOST, RATE = 0.1, 0.02


@given(steps=st.lists(st.tuples(st.floats(0.0, 30.0), AMOUNTS), max_size=50))
def test_expenses_never_exceed_the_income_by_more_than_the_savings_and_one_expense(
    steps: list[tuple[float, float]],
) -> None:
    """If nothing is spent while the budget is negative; predicted budgets are reached in time."""
    limiter, now, spent = RateLimiter(MOST, RATE), 1000.0, 0.0
    for pause, amount in steps:
        now += pause
        left = limiter.budget(now)
        assert left <= MOST
        due = limiter.time_of(MOST / 2, now)
        assert (
            due == now if left >= MOST / 2 else (due - now) * RATE + left == pytest.approx(MOST / 2)
        )
        if left >= 0:
            limiter.spend(amount, now)
            spent += amount
            assert spent <= MOST + (now - 1000.0) * RATE + amount + 1e-9


@given(amounts=st.lists(st.floats(0.0, MOST / 50), max_size=50))
def test_a_refund_undoes_an_expense(amounts: list[float]) -> None:
    """It does not raise the budget above its limit."""
    limiter = RateLimiter(MOST, RATE)
    for amount in amounts:
        limiter.spend(amount, 5.0)
    for amount in amounts:
        limiter.refund(amount)
    assert limiter.budget(5.0) == pytest.approx(MOST)
    limiter.refund(1.0)
    assert limiter.budget(5.0) == MOST


def test_a_message_longer_than_any_hello_costs_the_same() -> None:
    """It is not decoded."""
    assert (
        message_cost(0)
        < message_cost(400)
        < message_cost(MAX_HELLO_BYTES)
        == message_cost(64 << 20)
    )


def ask(address: int, at: float) -> Question:
    return Question([b"%f" % at], f"10.0.0.{address}", b"", at)


@given(given=st.lists(st.one_of(st.none(), st.integers(0, 3)), max_size=60))
def test_addresses_take_turns(
    given: list[int | None],
) -> None:
    """Within an address, the oldest question is next; None stands for a turn."""
    queue, waiting, since = QuestionQueue(), dict[str, list[Question]](), dict[str, set[str]]()
    for at, address in enumerate(given + [None] * len(given)):
        if address is not None:
            question = ask(address, at)
            queue.add(question)
            waiting.setdefault(question.address, []).append(question)
            continue
        question = queue.next()
        if question is None:
            assert not waiting
            continue
        name = question.address
        assert waiting[name].pop(0) == question
        if not waiting[name]:
            del waiting[name]
        # Addresses with a turn since each other one was served, or came.
        for other in waiting:
            if other != name:
                assert name not in since.setdefault(other, set())
                since[other].add(name)
        since.pop(name, None)
        since = {other: had for other, had in since.items() if other in waiting}
    assert not queue


def test_questions_that_are_too_old_are_dropped() -> None:
    """Their connections have been given up."""
    queue = QuestionQueue()
    for at in range(10):
        queue.add(ask(at % 2, at))
    queue.drop_before(7.5)
    assert len(queue) == 2
    assert [question.at for question in (queue.next(), queue.next()) if question] == [8, 9]
    queue.add(ask(0, 10))
    queue.drop_before(11)
    assert not queue


class Asker:
    """ZMQ's side of an `Authenticator`: asks about connections, all from one address."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self._socket = context.socket(zmq.DEALER)
        self._socket.connect("inproc://zeromq.zap.01")

    def ask(self, number: int, key: bytes) -> None:
        head = [b"", b"1.0", b"%d" % number, b"", b"10.0.0.1", b""]
        self._socket.send_multipart([*head, b"CURVE", z85.decode(key)])

    def answers(self) -> list[tuple[int, bytes]]:
        """Return the answers so far: number of the question, and verdict."""
        found: list[tuple[int, bytes]] = []
        while self._socket.poll(0):
            _, _, number, verdict, *_ = self._socket.recv_multipart()
            found.append((int(number), verdict))
        return found


def test_a_known_key_does_not_wait_behind_other_peers(tmp_path: Path) -> None:
    """The budget is used up, and they came first. A deleted key is unknown."""
    (arm,) = make_keys(tmp_path, ["arm"])
    known = read_client_keys(arm).public
    authenticator = Authenticator(
        tmp_path / "server", RateLimiter(CONNECTION_COST, 1e-9), LimitedLog("robots-0")
    )
    context = zmq.Context[zmq.Socket[bytes]]()
    try:
        router = context.socket(zmq.ROUTER)
        authenticator.open(context, router)
        asker = Asker(context)
        for number in range(3):
            asker.ask(number, zmq.curve_keypair()[0])
        assert authenticator.answer_questions(1000.0)
        assert asker.answers() == [(0, b"400")]
        asker.ask(3, known)
        assert authenticator.answer_questions(1000.0)
        assert asker.answers() == [(3, b"200")]
        (tmp_path / "server" / "clients" / "arm.key").unlink()
        for number in (4, 5):
            asker.ask(number, known)
        assert authenticator.answer_questions(1000.0)
        assert asker.answers() == [(4, b"400")]
    finally:
        context.destroy(linger=0)
