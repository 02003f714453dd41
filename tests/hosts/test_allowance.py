"""What strangers may take, and whose turn it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st
from zmq.utils import z85

from rlightning_aio.hosts.allowance import CONNECTION, Allowance, price
from rlightning_aio.hosts.gate import Gate, Question, Turns
from rlightning_aio.protocol.net.wire import MAX_HELLO_BYTES
from rlightning_aio.remote import make_keys
from rlightning_aio.remote.keys import read_client_keys

if TYPE_CHECKING:
    from pathlib import Path

AMOUNTS = st.floats(0.0, 0.5)
MOST, RATE = 0.1, 0.02


@given(steps=st.lists(st.tuples(st.floats(0.0, 30.0), AMOUNTS), max_size=50))
def test_what_is_spent_is_what_came_in_and_was_saved_and_a_single_expense(
    steps: list[tuple[float, float]],
) -> None:
    """If something is spent only while nothing is owed; and what is said to come does."""
    allowance, now, spent = Allowance(MOST, RATE), 1000.0, 0.0
    for pause, amount in steps:
        now += pause
        left = allowance.left(now)
        assert left <= MOST
        due = allowance.time_of(MOST / 2, now)
        assert (
            due == now if left >= MOST / 2 else (due - now) * RATE + left == pytest.approx(MOST / 2)
        )
        if left >= 0:
            allowance.spend(amount, now)
            spent += amount
            assert spent <= MOST + (now - 1000.0) * RATE + amount + 1e-9


@given(amounts=st.lists(st.floats(0.0, MOST / 50), max_size=50))
def test_what_is_given_back_was_never_spent(amounts: list[float]) -> None:
    """And no more can be saved by it."""
    allowance = Allowance(MOST, RATE)
    for amount in amounts:
        allowance.spend(amount, 5.0)
    for amount in amounts:
        allowance.give_back(amount)
    assert allowance.left(5.0) == pytest.approx(MOST)
    allowance.give_back(1.0)
    assert allowance.left(5.0) == MOST


def test_a_message_beyond_the_longest_hello_costs_no_more() -> None:
    """Nobody understands it."""
    assert price(0) < price(400) < price(MAX_HELLO_BYTES) == price(64 << 20)


def ask(address: int, at: float) -> Question:
    return Question([b"%f" % at], f"10.0.0.{address}", b"", at)


@given(given=st.lists(st.one_of(st.none(), st.integers(0, 3)), max_size=60))
def test_everybody_has_a_turn_and_no_address_two_while_another_waits(
    given: list[int | None],
) -> None:
    """Within an address, who came first; None stands for a turn."""
    turns, waiting, since = Turns(), dict[str, list[Question]](), dict[str, set[str]]()
    for at, address in enumerate(given + [None] * len(given)):
        if address is not None:
            question = ask(address, at)
            turns.add(question)
            waiting.setdefault(question.address, []).append(question)
            continue
        question = turns.next()
        if question is None:
            assert not waiting
            continue
        name = question.address
        assert waiting[name].pop(0) == question
        if not waiting[name]:
            del waiting[name]
        # Who has had a turn since each of the others was served, or came.
        for other in waiting:
            if other != name:
                assert name not in since.setdefault(other, set())
                since[other].add(name)
        since.pop(name, None)
        since = {other: had for other, had in since.items() if other in waiting}
    assert not turns


def test_questions_that_are_too_old_are_forgotten() -> None:
    """Whoever asked is gone."""
    turns = Turns()
    for at in range(10):
        turns.add(ask(at % 2, at))
    turns.forget(7.5)
    assert len(turns) == 2
    assert [question.at for question in (turns.next(), turns.next()) if question] == [8, 9]
    turns.add(ask(0, 10))
    turns.forget(11)
    assert not turns


class Asker:
    """What ZMQ is to a `Gate`: it asks about connections, which all come from one address."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self._socket = context.socket(zmq.DEALER)
        self._socket.connect("inproc://zeromq.zap.01")

    def ask(self, number: int, key: bytes) -> None:
        head = [b"", b"1.0", b"%d" % number, b"", b"10.0.0.1", b""]
        self._socket.send_multipart([*head, b"CURVE", z85.decode(key)])

    def answers(self) -> list[tuple[int, bytes, bytes]]:
        """Those that have come: to which question, the verdict, and whose the key is."""
        found: list[tuple[int, bytes, bytes]] = []
        while self._socket.poll(0):
            _, _, number, verdict, _, user, _ = self._socket.recv_multipart()
            found.append((int(number), verdict, user))
        return found


def test_a_known_key_does_not_wait_behind_strangers(tmp_path: Path) -> None:
    """Nothing is left for them, and they were there first. A key that is deleted is nobody's."""
    (arm,) = make_keys(tmp_path, ["arm"])
    known = read_client_keys(arm).public
    gate = Gate(tmp_path / "server", Allowance(CONNECTION, 1e-9))
    context = zmq.Context[zmq.Socket[bytes]]()
    try:
        router = context.socket(zmq.ROUTER)
        gate.open(context, router)
        asker = Asker(context)
        for number in range(3):
            asker.ask(number, zmq.curve_keypair()[0])
        assert gate.look(1000.0)
        assert asker.answers() == [(0, b"400", b"")]
        asker.ask(3, known)
        assert gate.look(1000.0)
        assert asker.answers() == [(3, b"200", b"arm")]
        (tmp_path / "server" / "clients" / "arm.key").unlink()
        for number in (4, 5):
            asker.ask(number, known)
        assert gate.look(1000.0)
        assert asker.answers() == [(4, b"400", b"")]
    finally:
        context.destroy(linger=0)
