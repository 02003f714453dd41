"""The rules of sessions, one by one, without a network."""

from __future__ import annotations

import logging
import math
import tracemalloc
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from remote.random_spaces import mutation
from remote.unreliable import OBSERVATION, Client, Recorder, World

from rlightning_aio.protocol.net.client_session import ClientSession, Phase, Refused
from rlightning_aio.protocol.net.payload import ResultFields
from rlightning_aio.protocol.net.server_session import ClientPlace, ServerSessions
from rlightning_aio.protocol.net.wire import ClientHello, Refusal, Reset, Step, Welcome, Writer
from rlightning_aio.types import EnvMeta


@pytest.fixture
def world() -> World:
    world = World()
    world.join_all()
    return world


def asked(world: World, name: str) -> int:
    """Ask a client for a reset that the test answers; return the number of the request."""
    client = world.clients[name]
    world.reset(name)
    world.to_client(client)
    assert client.todo is not None
    number, client.todo = client.todo.number, None
    return number


def test_the_first_request_of_a_session_is_a_reset(world: World) -> None:
    """A client refuses another one, and moves nothing."""
    world.step("a")
    world.settle()
    assert "the first request of a session is not a reset" in world.clients["a"].ended[0]
    assert not world.clients["a"].executed


def test_an_answer_that_nobody_waits_for_ends_the_session(world: World) -> None:
    """A second answer, and one to another request."""
    for name, count in (("a", 2), ("b", 1)):
        client, number = world.clients[name], asked(world, name)
        for _ in range(count):
            client.session.finish(number + (name == "b"), client.ret())
        client.flush()
        world.settle()
        assert "which is not in flight" in client.ended[0]
    assert world.server.clients() == {}
    assert [len(one.answers) for one in world.seen] == [1, 0]
    assert [len(one.lost) for one in world.seen] == [1, 1]


def test_who_gets_which_place() -> None:
    """First the last one, then the one whose request has waited longest, then the first."""
    world = World("abcd", places=3)
    world.clients["b"].connect()
    world.settle()
    assert world.server.clients() == {"srv/0": "b"}
    world.seen[1].since, world.seen[2].since = 5.0, 4.0
    world.clients["a"].connect()
    world.settle()
    assert world.server.clients() == {"srv/0": "b", "srv/2": "a"}
    world.clients["b"].cut()
    world.settle()
    world.clients["b"].connect()
    world.settle()
    assert world.server.clients() == {"srv/0": "b", "srv/2": "a"}
    world.join_all()
    assert world.clients["d"].refused == [
        "all 3 places are taken; for more, set env_kwargs.clients of the entry"
    ]
    world.clients["c"].leave()
    world.settle()
    world.clients["d"].connect()
    world.settle()
    assert world.server.clients()["srv/1"] == "d"


def test_a_listed_name_has_its_own_place() -> None:
    """Others are refused for good, whether there is room or not."""
    world = World("abx", places="ba")
    world.join_all()
    assert world.server.clients() == {"srv/b": "b", "srv/a": "a"}
    why = "the places of srv are for b, a, as env_kwargs.clients says"
    assert world.clients["x"].refused == [why]
    assert world.server.refused == {"x": why}


def test_a_key_is_for_the_names_that_it_was_made_for() -> None:
    """A client that was refused, and let in since, is no longer among the refused."""
    world, client = World(""), Client("c")
    for allowed, why in ("arm", "its key was made for 'arm', not for 'c'"), ("c", None):
        client.session.connected()
        world.server.receive(b"c:9", client.session.outbox.popleft(), {allowed})
        assert world.server.refused.get("c") == why


def test_a_second_client_of_a_name_waits_until_the_first_is_gone(world: World) -> None:
    """The present client keeps its session."""
    second = Client("a")
    second.routes = iter(range(50, 60))
    first, world.clients["a"] = world.clients["a"], second
    second.connect()
    world.settle()
    assert second.refused == ["a client named 'a' is here already"]
    assert first.session.phase is Phase.SERVING
    # A message to the first one finds no connection.
    world.reset("a")
    second.connect()
    world.settle()
    assert second.session.phase is Phase.SERVING


def meta(**changes: Any) -> EnvMeta:
    fields: dict[str, Any] = {
        "env_id": "env",
        "observation_space": OBSERVATION,
        "action_space": gym.spaces.Discrete(2),
    }
    return EnvMeta(**{**fields, **changes})


@pytest.mark.parametrize(
    ("name", "changes", "says"),
    [
        ("c/d", {}, "must be printable and without '/'"),
        ("c\n", {}, "must be printable and without '/'"),
        ("c", {}, "its spaces or agents differ"),
        ("c", {"action_space": gym.spaces.Box(-1, 1, (2,)), "num_envs": 2}, "2 sub-environments"),
        ("c", {"action_space": gym.spaces.Box(-1, 1, (2,)), "agents": ("x",)}, "differ"),
    ],
)
def test_a_client_that_does_not_fit_is_refused_for_good(
    world: World, name: str, changes: dict[str, Any], says: str
) -> None:
    """The client receives the reason and gives up; that the places are taken doesn't matter."""
    other_client = ClientSession(meta(**changes), name)
    other_client.connected()
    world.server.receive(b"r", other_client.outbox.popleft())
    event = other_client.receive(world.server.outbox.popleft().parts)
    assert isinstance(event, Refused)
    assert not event.retry
    assert says in event.text
    assert says in next(iter(world.server.refused.values()))


def test_another_version_is_refused_with_both_versions(world: World) -> None:
    """Neither side guesses."""
    hello = ClientHello(version=9, name="z", observation_space={}, action_space={})
    world.server.receive(b"r", Writer().write(hello))
    assert b"speaks version 3, not 9" in world.server.outbox.popleft().parts[0]


@pytest.mark.parametrize(("hardware", "heartbeat"), [(True, 1.0), (False, 5.0)])
def test_the_welcome_says_how_soon_either_end_misses_the_other(
    hardware: bool, heartbeat: float
) -> None:
    """Sooner where something real moves; a client that doesn't say so counts as that."""
    world = World("")
    session = ClientSession(meta(), "a", hardware=hardware)
    session.connected()
    hello = session.outbox.popleft()
    world.server.receive(b"r", hello)
    event = session.receive(world.server.outbox.popleft().parts)
    assert event.heartbeat == heartbeat
    assert ClientHello(version=3, name="a", observation_space={}, action_space={}).hardware


@pytest.mark.parametrize("spoil", ["whole", "frame"])
def test_a_message_that_is_malformed_ends_the_session(spoil: str) -> None:
    """It says why."""
    world = World("a")
    world.join_all()
    client = world.clients["a"]
    world.reset("a")
    world.to_client(client)
    client.execute()
    (_, parts), client.outbox[:] = client.outbox[0], []
    header, _ = parts or []
    spoilt = {"whole": [b"nonsense"], "frame": [header, b"short"]}[spoil]
    world.server.receive(client.route or b"", spoilt)
    world.flush()
    assert "a message of it is malformed" in world.seen[0].lost[0][0]
    world.settle()
    assert client.ended
    world.join_all()
    assert world.serving("a")


@pytest.mark.parametrize("parts", [[b"\xc1"], Writer().write(Step(number=2))])
def test_a_client_hangs_up_at_a_malformed_message(world: World, parts: list[bytes]) -> None:
    """Such as a step without its action. It ends its session with the reason, and comes back."""
    client = world.clients["a"]
    world.reset("a")
    world.settle()
    client.receive(parts)
    assert "a message of the server is malformed" in client.ended[0]
    world.settle()
    assert "it left: a message of the server is malformed" in world.seen[0].lost[0][0]
    world.join_all()
    assert world.serving("a")


def test_info_that_cannot_be_sent_is_left_out_and_named_once(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    """A value that is an object, and a key that is a number, for which the server would refuse the
    result, and request it forever. The rest arrives each time.
    """
    client = world.clients["a"]
    info: dict[Any, Any] = {"fine": {1: 2}, "camera": object(), 0: "cup"}
    for _ in range(2):
        outcome = ResultFields(np.zeros(3), 1.0, False, False)
        client.session.answer(asked(world, "a"), outcome, info, {}, 0, 0)
        client.flush()
        world.settle()
    assert [message.info for _, message in world.take()] == [{"fine": {1: 2}}] * 2
    assert [record.message for record in caplog.records] == [
        "a: 0, camera of the env's info can't be sent and is left out"
    ]


def test_extras_are_sent_to_a_client_that_reads_them() -> None:
    """Columns of the policy reach the env; those that can't be sent are dropped."""
    seen = Recorder()
    place = ClientPlace("srv/0", seen)
    server = ServerSessions("srv", [place])
    session = ClientSession(meta(), "a", reads_extras=True, free_actions=True)
    session.connected()
    server.receive(b"r", session.outbox.popleft())
    session.receive(server.outbox.popleft().parts)
    server.reset(place, None, None)
    event: Any = session.receive(server.outbox.popleft().parts)
    session.answer(event.number, ResultFields(np.zeros(3), 0.0, False, False), {}, {}, 0, 0)
    server.receive(b"r", session.outbox.popleft())
    chunk = {"chunk": np.ones((4, 2)), "mode": "fast"}
    server.step(place, chunk, {"log_prob": -0.5, "net": object()})
    event = session.receive(server.outbox.popleft().parts)
    assert np.array_equal(event.action["chunk"], chunk["chunk"])
    assert event.action["mode"] == "fast"
    assert event.extras == {"log_prob": -0.5}


@pytest.mark.parametrize(
    "stray",
    [
        Welcome(env_id="x", heartbeat=5.0),
        Welcome(env_id="x", heartbeat=0.0),
        Refusal(text="no", retry=False),
        Step(number=1),
    ],
)
def test_a_client_ends_a_session_whose_server_breaks_the_rules(world: World, stray: Any) -> None:
    client = world.clients["a"]
    client.receive(Writer().write(stray))
    assert client.ended


@pytest.mark.parametrize(
    "first",
    [
        Reset(number=1),
        *(
            Welcome(env_id="x", heartbeat=seconds)
            for seconds in (-1.0, 0.0, 0.39, 86401.0, math.inf, math.nan)
        ),
    ],
)
def test_what_can_not_follow_a_hello_is_refused(first: Any) -> None:
    """A request without a session, and a heartbeat that a client can't keep: it would take that for
    its connections, and not come back.
    """
    session = ClientSession(meta(), "a")
    session.connected()
    event: Any = session.receive(Writer().write(first))
    assert "a message of the server is malformed" in event.text


def test_corrupted_messages_do_no_harm(caplog: pytest.LogCaptureFixture) -> None:
    """They end a session at most. Every request between them is answered, and nothing piles up."""
    caplog.set_level(logging.ERROR, "rlightning_aio.remote")  # Which pytest keeps.
    rng, world, held = np.random.default_rng(0), World(), 0
    tracemalloc.start()
    try:
        for number in range(400):
            name = "ab"[number % 2]
            client = world.clients[name]
            world.join_all()
            world.take()
            world.reset(name)
            world.settle()
            assert len(world.take()) == 1
            stranger = {"name": f"peer-{number % 100}", "observation_space": {}, "action_space": {}}
            hello = Writer().write(ClientHello(version=number % 4, **stranger))
            for parts in (hello, mutation(rng)(hello)):
                world.server.receive(b"nobody:1", parts)
                world.flush()
            for (one, to_server), said in world.delivered.items():
                if one != name:
                    continue
                parts = mutation(rng)(said[int(rng.integers(len(said)))])
                if to_server:
                    world.server.receive(client.route or f"{name}:-".encode(), parts)
                    world.flush()
                elif client.route is not None:
                    client.receive(parts)
            for records in (client.executed, client.ended, client.refused, world.delivered):
                records.clear()  # The test's own.
            if number == 200:
                held = tracemalloc.get_traced_memory()[0]
        assert tracemalloc.get_traced_memory()[0] - held < 200_000
    finally:
        tracemalloc.stop()
