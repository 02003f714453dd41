"""Every hello is admitted or refused, whatever it contains, and costs next to nothing."""

from __future__ import annotations

import logging
import warnings
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kit.counting import ClientThread, CountingEnv, served
from patience import HANG
from remote.random_spaces import any_space
from remote.unreliable import Recorder

from rlightning_aio import sync
from rlightning_aio.errors import EnvRaised
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.protocol.net.server_session import ClientPlace, ServerSessions
from rlightning_aio.protocol.net.space_description import describe
from rlightning_aio.protocol.net.wire import (
    VERSION,
    Bye,
    ClientHello,
    Failure,
    Writer,
)

if TYPE_CHECKING:
    from rlightning_aio.types import EnvRet, PolicyResponse

TOP = 2**63 - 1
SMALL = {"type": "discrete", "n": 2}
ESCAPES = "\x1b[2J\r\nfake: \u202e line\x07"


def hello(name: str = "x", **fields: Any) -> list[bytes]:
    said = {"observation_space": SMALL, "action_space": SMALL, **fields}
    return Writer().write(ClientHello(version=VERSION, name=name, **said))


def answers(server: ServerSessions) -> list[dict[str, Any]]:
    """Return the messages of the server since the last call."""
    said = [msgspec.msgpack.decode(outgoing.parts[0]) for outgoing in server.outbox]
    server.outbox.clear()
    return said


HOSTILE: list[Any] = [
    {"type": "discrete", "n": TOP, "start": TOP},
    {"type": "discrete", "n": TOP, "start": 1},
    {"type": "discrete", "n": 2**64 - 1},
    {"type": "discrete", "n": 1, "start": -(2**63)},
    {"type": "discrete", "n": 300, "dtype": "uint8"},
    {"type": "discrete", "n": 2, "dtype": "float64"},
    {"type": "discrete", "n": 2, "dtype": "bool"},
    {"type": "discrete", "n": 0},
    {"type": "multi_discrete", "nvec": [TOP, TOP], "start": [TOP, 0]},
    {"type": "multi_discrete", "nvec": [[1], [1, 2]]},
    {"type": "multi_discrete", "nvec": []},
    {"type": "multi_binary", "n": 1 << 62},
    {"type": "multi_binary", "n": [1 << 40, 0]},
    {"type": "box", "shape": [2], "dtype": "float16", "low": -1e300, "high": 1e300},
    {"type": "box", "shape": [2], "dtype": "float32", "low": 5e-324, "high": 1.1},
    {"type": "box", "shape": [2], "dtype": "uint8", "low": "-inf", "high": "inf"},
    {"type": "box", "shape": [2], "dtype": "int64", "low": -(2**63), "high": TOP},
    {"type": "box", "shape": [2], "dtype": "int64", "low": -(2**63), "high": 2**64 - 1},
    {"type": "box", "shape": [0, 1 << 62], "dtype": "int8", "low": 0, "high": 1},
    {"type": "box", "shape": [1 << 40, 1 << 40], "dtype": "int8", "low": 0, "high": 1},
    {"type": "box", "shape": [2], "dtype": "float64", "low": [[0.0]], "high": [1, 2, 3]},
    {"type": "text", "max_length": 5, "min_length": 9, "charset": "\x1b"},
    {"type": "dict", "spaces": [[ESCAPES, SMALL]]},
    {"type": "tuple", "spaces": []},
    {"type": ESCAPES},
    {"type": "x" * 100_000},
    {},
]


@pytest.mark.parametrize("place", ["observation_space", "action_space"])
def test_every_hello_is_answered(place: str) -> None:
    """Also if arithmetic errors and warnings raise in the trainer."""
    server = ServerSessions("srv", [ClientPlace("srv/0", Recorder())])
    with np.errstate(all="raise"), warnings.catch_warnings():
        warnings.simplefilter("error")
        for k, description in enumerate(HOSTILE):
            server.receive(b"%d" % k, hello(f"c{k}", **{place: description}))
            (answer,) = answers(server)
            assert answer["type"] in ("welcome", "refusal")
            assert answer.get("text", "").isprintable()
            assert len(answer.get("text", "")) < 1100


_BIG = st.sampled_from([0, 1, 2, 127, 255, 2**31, 2**62, TOP, 2**64 - 1, -1, -(2**63)])
_ANYTHING = st.one_of(_BIG, st.floats(), st.text(max_size=3), st.none(), st.lists(_BIG, max_size=3))


@given(space=any_space, data=st.data())
def test_a_description_with_any_field_changed_is_answered(space: Any, data: st.DataObject) -> None:
    """At any depth, or the whole message is dropped."""
    fields = description = describe(space, "space")
    while fields["type"] in ("dict", "tuple") and fields["spaces"] and data.draw(st.booleans()):
        inner = data.draw(st.sampled_from(fields["spaces"]))
        fields = inner[1] if isinstance(inner, list) else inner
    fields[data.draw(st.sampled_from(sorted(fields)))] = data.draw(_ANYTHING)
    server = ServerSessions("srv", [ClientPlace("srv/0", Recorder())])
    with np.errstate(all="raise"), warnings.catch_warnings():
        warnings.simplefilter("error")
        server.receive(b"r", hello(observation_space=description))
    assert len(server.outbox) <= 1


def test_a_hello_of_any_length_costs_little() -> None:
    """It is refused before its spaces are read."""
    server = ServerSessions("srv", [ClientPlace("srv/0", Recorder())])
    long = {"type": "multi_discrete", "nvec": [1] * 300_000}
    server.receive(b"r", hello(observation_space=long))
    (answer,) = answers(server)
    assert not answer["retry"]
    assert "262144 are allowed" in answer["text"]


def test_texts_of_clients_are_shown_without_control_characters(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Reasons and errors in logs, infos and exceptions."""
    seen = Recorder()
    place = ClientPlace("srv/0", seen)
    server = ServerSessions("srv", [place])
    long = ESCAPES * 10_000
    with caplog.at_level(logging.INFO, "rlightning_aio"):
        server.receive(b"r", hello("raises"))
        server.reset(place, None, None)
        failure = Failure(number=1, exception_type=long, text=long, traceback=long)
        server.receive(b"r", Writer().write(failure))
        server.receive(b"r", Writer().write(Bye(reason=long)))
        server.receive(b"r", hello(ESCAPES))
        server.receive(b"r", hello(observation_space={"type": ESCAPES}))
        server.receive(b"r", [msgspec.msgpack.encode({"type": ESCAPES})])
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == 5
    assert all(message.isprintable() and len(message) < 2500 for message in messages)
    ((cause, _),) = seen.lost
    (error,) = seen.answers
    assert isinstance(error, ErrorText)
    for text in (cause, error.text, error.summary):
        assert text.isprintable()
        assert "fake: " in text


class _Hostile(CountingEnv):
    """Its rewards overflow sums, and its texts contain terminal codes."""

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        super().step(policy_resp)
        if self.steps == 5:
            raise RuntimeError(ESCAPES)
        ret = self.ret()
        ret.last_reward = 1e308
        ret.observation = np.array([5e-324, np.nan, np.inf])
        return ret


def test_numbers_of_clients_raise_nothing_in_a_trainer_with_strict_arithmetic() -> None:
    """An error of the env is shown without control characters."""
    with (
        np.errstate(all="raise"),
        sync.build_env_group(served()) as group,
    ):
        friend = ClientThread(group["robots-0"].address, "arm", _Hostile())
        batch, _ = group.reset()
        for _ in range(4):
            group.step_async(batch.respond(action=np.zeros((1, 2), np.float32)))
            batch, _ = group.collect_async(deadline=HANG)
        group.step_async(batch.respond(action=np.zeros((1, 2), np.float32)))
        with pytest.raises(EnvRaised) as caught:
            group.collect_async(deadline=HANG)
        group.close()
        friend.join()
    error = caught.value
    assert str(error).isprintable()
    assert "\\x1b[2J\\r\\nfake: \\u202e line\\x07" in str(error)
    assert error.exception_text.isprintable()
    assert "\x1b" not in error.traceback_text
    assert len(error.traceback_text.splitlines()) > 3
