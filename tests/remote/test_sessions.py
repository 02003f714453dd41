"""The rules of sessions, one by one, without a network."""

from __future__ import annotations

import logging
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from remote.unreliable import OBSERVATION, Client, World

from rlightning_aio.errors import BadAction, EnvBusy, UnknownEnv
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.protocol.net.client_session import ClientSession, Phase, Refused
from rlightning_aio.protocol.net.payload import ResultFields
from rlightning_aio.protocol.net.server_session import ServerSessions
from rlightning_aio.protocol.net.wire import ClientHello, Refusal, Welcome, Writer
from rlightning_aio.types import EnvMeta, EnvRet


@pytest.fixture
def world() -> World:
    world = World()
    world.join_all()
    return world


def only(results: list[Any]) -> Any:
    (result,) = results
    return result


def test_a_client_that_joins_sends_its_first_result_without_a_request(world: World) -> None:
    """Joining is a reset, and its result answers no request."""
    first = {result.client: result for result in world.take()}
    assert set(first) == set(world.server.clients) == {"a", "b"}
    assert first["a"].number is None
    assert first["a"].observation.tolist() == [1, 1, 0]
    assert world.server.clients["b"].env_id == "srv/b"


def test_a_step_and_a_reset_come_back_under_their_numbers(world: World) -> None:
    """Numbers are the caller's own, whatever travels."""
    world.take()
    assert world.submit("a", 70)
    world.settle()
    assert only(world.take()).number == 70
    assert world.submit_reset("a", 5)
    world.settle()
    result = only(world.take())
    assert (result.number, result.observation[2]) == (5, 0)


def test_a_client_with_a_pending_request_is_busy(world: World) -> None:
    """A second request is refused before anything is sent."""
    world.submit("a", 1)
    with pytest.raises(EnvBusy, match="srv/a has not answered its last step"):
        world.submit("a", 2)


def test_a_client_that_never_joined_is_unknown(world: World) -> None:
    """No request to it is sent or answered."""
    with pytest.raises(UnknownEnv, match="no client named 'c' is connected to srv"):
        world.server.traits("c")
    assert not world.submit("c", 1)
    assert not world.submit_reset("c", 2)


def test_an_action_that_does_not_fit_is_not_sent(world: World) -> None:
    """The client stays free for a better one."""
    with pytest.raises(BadAction, match=r"srv/a.*expected shape \(2,\)"):
        world.server.step("a", 1, np.zeros(3, np.float32), {}, 0.0)
    assert world.submit("a", 2)


@pytest.mark.parametrize("options", [{"x": object()}, {0: "x"}, {"x": {"y": 2**70}}])
def test_reset_options_that_cannot_travel_are_refused(world: World, options: Any) -> None:
    """They would arrive as something else, or not at all."""
    with pytest.raises(ValueError, match="options can't be sent"):
        world.submit_reset("a", 1, options=options)
    assert world.submit_reset("a", 2)


def test_an_exception_arrives_with_its_traceback_and_the_env_goes_on(world: World) -> None:
    """The env can be stepped again after it raised."""
    world.take()
    client = world.clients["a"]
    client.raises = True
    world.submit("a", 1)
    world.settle()
    result = only(world.take())
    assert result.number == 1
    assert result.error == ErrorText("Oops", "no", "trace")
    client.raises = False
    world.submit("a", 2)
    world.settle()
    assert only(world.take()).error is None


def test_an_answer_that_nobody_waits_for_ends_the_session(world: World) -> None:
    """A second answer, and one to another request."""
    world.take()
    for name, count in (("a", 2), ("b", 1)):
        client = world.clients[name]
        world.submit(name, 1)
        world.to_client(client)
        number = client.todo.number if client.todo else 0
        for _ in range(count):
            client.session.finish(number + (name == "b"), client.ret())
        client.todo = None
        client.flush()
        world.settle()
        assert "which is not in flight" in client.ended[0]
        assert name not in world.server.clients
    answered, lost = world.take()
    assert (answered.client, answered.is_loss) == ("a", False)
    assert (lost.client, lost.is_loss) == ("b", True)


def test_a_client_that_dies_in_a_step_leaves_one_marked_result(world: World) -> None:
    """Truncated, at its last observation, with the cause."""
    world.take()
    world.submit("a", 1)
    world.clients["a"].kill()
    world.settle()
    assert "a" not in world.server.clients
    result = only(world.take())
    assert (result.number, result.truncated, result.terminated) == (1, True, False)
    assert result.observation.tolist() == [1, 1, 0]
    assert "connection broke" in result.info["client_lost"]


def test_a_request_to_a_client_that_is_known_to_be_absent_is_not_answered(world: World) -> None:
    """There is no series of marked results: the next result is the client's first one."""
    world.submit("a", 1)
    world.clients["a"].kill()
    world.settle()
    world.take()
    assert not world.submit("a", 2)
    assert not world.take()
    world.clients["a"].connect()
    world.settle()
    result = only(world.take())
    assert result.number is None
    assert result.observation.tolist() == [1, 2, 0]


def test_a_loss_without_a_pending_request_is_reported_by_the_next_step(world: World) -> None:
    """The trainer learns that the episode ended before it sees the next one."""
    world.take()
    world.clients["a"].kill()
    world.clients["a"].connect()
    world.settle()
    assert not world.take(), "the first result waits until the loss is reported"
    assert world.submit("a", 1)
    lost, first = world.take()
    assert "client_lost" in lost.info
    assert (first.number, first.observation.tolist()) == (None, [1, 2, 0])


def test_a_reset_replaces_a_loss_and_a_first_result(world: World) -> None:
    """After a reset, the end of the last episode does not matter."""
    world.take()
    world.clients["a"].kill()
    world.clients["a"].connect()
    world.settle()
    assert world.submit_reset("a", 2)
    world.settle()
    assert only(world.take()).number == 2


def test_a_client_is_lost_again_after_a_reset_that_replaced_its_first_result(world: World) -> None:
    """The marked result shows the observation that the reset began with."""
    world.take()
    world.clients["a"].kill()
    world.clients["a"].connect()
    world.settle()
    assert world.submit_reset("a", 1)
    world.clients["a"].kill()
    world.settle()
    lost = only(world.take())
    assert (lost.number, lost.is_loss, lost.observation.tolist()) == (1, True, [1, 2, 0])


def test_a_client_that_is_lost_again_unseen_reports_the_first_loss(world: World) -> None:
    """Nobody has seen the session in between."""
    world.take()
    world.clients["a"].cut()
    world.clients["a"].connect()
    world.settle()
    world.clients["a"].leave()
    world.settle()
    assert world.submit("a", 1)
    assert "its connection broke" in only(world.take()).info["client_lost"]
    assert not world.submit("a", 2)


def test_a_broken_connection_ends_the_session_on_both_sides(world: World) -> None:
    """The env must be made safe, and another session begins; nothing is sent twice."""
    world.take()
    client = world.clients["a"]
    world.submit("a", 1)
    world.to_client(client)
    client.cut()
    assert client.ended == ["the connection broke"]
    client.execute()
    client.connect()
    world.settle()
    lost, first = world.take()
    assert (lost.number, lost.is_loss, first.number) == (1, True, None)
    assert client.session.phase is Phase.SERVING
    assert (client.steps, len(client.executed)) == (0, 2)


def test_an_answer_over_a_connection_that_is_gone_is_not_sent_over_the_next(world: World) -> None:
    """A step may end after its session has."""
    world.take()
    client = world.clients["a"]
    world.submit("a", 1)
    world.to_client(client)
    assert client.todo is not None
    number = client.todo.number
    client.cut()
    client.session.finish(number, client.ret())
    client.flush()
    assert not client.outbox[1:]


def test_a_busy_client_may_be_silent_without_limit(world: World) -> None:
    """A step may take hours; the connection shows that the client lives."""
    world.take()
    client = world.clients["a"]
    world.submit("a", 1)
    world.to_client(client)
    world.pass_time(10_000.0)
    assert world.server.deadline() is None
    client.execute()
    world.settle()
    assert only(world.take()).number == 1


def test_a_step_past_its_timeout_loses_the_client() -> None:
    """One marked result; the client learns that its session is over."""
    world = World(step_timeout=3.0)
    world.join_all()
    world.take()
    client = world.clients["a"]
    world.submit("a", 1)
    world.to_client(client)
    while "a" in world.server.clients:
        world.pass_time(0.5)
    assert world.now <= 4.0
    assert "no result of a step within 3.0 s" in only(world.take()).info["client_lost"]
    client.execute()
    world.settle()
    assert any("within 3.0 s" in cause for cause in client.ended)


def test_a_client_that_leaves_sends_a_reason(world: World) -> None:
    """Its reason is in the marked result."""
    world.take()
    world.submit("a", 1)
    world.clients["a"].leave()
    world.settle()
    assert "it left: enough" in only(world.take()).info["client_lost"]


def test_a_client_that_leaves_before_the_trainer_saw_it_may_come_back() -> None:
    """There is no loss to report, because no request would report it."""
    world = World("a")
    client = world.clients["a"]
    client.connect()
    world.to_server(client)
    world.to_client(client)
    client.execute()
    client.leave()
    for route, parts in client.outbox:  # All have arrived when the trainer reads.
        if parts is None:
            world.server.disconnected(route)
        else:
            world.server.receive(route, parts)
    client.outbox.clear()
    world.flush()
    assert not world.take()
    client.connect()
    world.settle()
    assert only(world.take()).observation.tolist() == [1, 2, 0]


def test_a_client_that_was_dismissed_for_lack_of_room_may_come_back(world: World) -> None:
    """Its first result is reported as if it had never been there."""
    world.take()
    world.server.dismiss("a", "no place")
    world.flush()
    world.settle()
    assert world.clients["a"].ended == ["the server ended the session: no place"]
    world.join_all()
    assert only(world.take()).number is None


def test_a_second_client_of_a_name_waits_until_the_first_is_gone(world: World) -> None:
    """The present client keeps its session."""
    second = Client("a", 9)
    second.routes = iter(range(50, 60))
    first, world.clients["a"] = world.clients["a"], second
    second.connect()
    world.settle()
    assert second.refused == ["a client named 'a' is here already"]
    assert first.session.phase is Phase.SERVING
    # A message to the first one finds no connection.
    world.submit("a", 1)
    second.connect()
    world.settle()
    assert second.session.phase is Phase.SERVING


def test_a_restarted_server_gets_its_clients_back() -> None:
    """A new server knows no session; the client says hello again."""
    world = World("a")
    world.join_all()
    client = world.clients["a"]
    world.server = ServerSessions("srv")
    client.cut()
    world.join_all()
    assert client.session.phase is Phase.SERVING
    assert set(world.server.clients) == {"a"}


def test_a_server_that_closes_says_goodbye(world: World) -> None:
    """Clients end their sessions at once and hang up."""
    world.server.close("done")
    world.flush()
    world.settle()
    assert world.clients["a"].ended == ["the server ended the session: done"]
    assert world.clients["a"].session.phase is Phase.AWAY


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
        ("c", {}, "its spaces, num_envs or agents differ"),
        ("c", {"action_space": gym.spaces.Box(-1, 1, (2,)), "num_envs": 2}, "differ"),
        ("c", {"action_space": gym.spaces.Box(-1, 1, (2,)), "agents": ("x",)}, "differ"),
    ],
)
def test_a_client_that_does_not_fit_is_refused_for_good(
    world: World, name: str, changes: dict[str, Any], says: str
) -> None:
    """The client receives the reason and gives up."""
    other_client = ClientSession(meta(**changes), name)
    other_client.connected()
    world.server.receive(b"r", other_client.outbox.popleft())
    event = other_client.receive(world.server.outbox.popleft().parts)
    assert isinstance(event, Refused)
    assert not event.retry
    assert says in event.text
    assert "c" not in world.server.clients


def test_another_version_is_refused_with_both_versions(world: World) -> None:
    """Neither side guesses."""
    hello = ClientHello(version=9, name="z", observation_space={}, action_space={})
    world.server.receive(b"r", Writer().write(hello))
    assert b"speaks version 2, not 9" in world.server.outbox.popleft().parts[0]


def test_a_session_is_that_of_its_connection(world: World) -> None:
    """Nothing that another connection says belongs to it."""
    world.take()
    world.submit("a", 1)
    client = world.clients["a"]
    world.to_client(client)
    client.execute()
    (_, result), client.outbox[:] = client.outbox[0], []
    assert result is not None
    world.server.receive(b"s", result)
    assert not world.server.take()
    assert client.route
    world.server.receive(client.route, result)
    assert only(world.server.take()).number == 1


def answered_once() -> tuple[World, Any, bytes, bytes]:
    """Return a client that has executed a step, and the parts of its unsent result."""
    world = World("a")
    world.join_all()
    world.take()
    client = world.clients["a"]
    world.submit("a", 1)
    world.to_client(client)
    client.execute()
    (_, parts), client.outbox[:] = client.outbox[0], []
    header, frame = parts or []
    return world, client, header, frame


@pytest.mark.parametrize("spoil", ["whole", "frame"])
def test_a_message_that_is_malformed_ends_the_session(spoil: str) -> None:
    """It says why."""
    world, client, header, _ = answered_once()
    parts = {"whole": [b"nonsense"], "frame": [header, b"short"]}[spoil]
    world.server.receive(client.route or b"", parts)
    world.flush()
    lost = only(world.take())
    assert lost.is_loss
    assert "a message of it" in lost.info["client_lost"]
    world.settle()
    assert client.ended
    world.join_all()
    assert world.submit("a", 2)


def test_a_client_hangs_up_at_a_malformed_message(world: World) -> None:
    """It ends its session with the reason, and comes back."""
    world.take()
    client = world.clients["a"]
    client.receive([b"\xc1"])
    assert "a message of the server is malformed" in client.ended[0]
    world.settle()
    assert world.submit("a", 1)
    assert "it left: a message of the server is malformed" in only(world.take()).info["client_lost"]
    world.join_all()
    assert world.serving("a")


def test_info_that_cannot_be_sent_is_named_once(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    """The result arrives without it, each time."""
    world.take()
    client = world.clients["a"]
    with caplog.at_level(logging.WARNING):
        for number in (1, 2):
            world.submit("a", number)
            world.to_client(client)
            assert client.todo is not None
            ret = client.ret()
            ret.info = {"fine": 1, "camera": object()}
            wire_number, client.todo = client.todo.number, None
            client.session.finish(wire_number, ret)
            client.flush()
            world.settle()
    assert [result.info for result in world.take()] == [{"fine": 1}] * 2
    assert [record.message for record in caplog.records] == [
        "a: camera of the env's info can't be sent and is left out"
    ]


def test_a_step_whose_info_has_a_number_as_key_is_answered(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    """Without that key. Otherwise the server would refuse the result and request it forever."""
    world.take()
    client = world.clients["a"]
    world.submit("a", 1)
    world.to_client(client)
    assert client.todo is not None
    number, client.todo = client.todo.number, None
    info: dict[Any, Any] = {"fine": {1: 2}, 0: "cup"}
    outcome = ResultFields(client.observation(), 1.0, False, False)
    # Like a client that forwards the results of a bare step.
    client.session.answer(number, outcome, info, {}, 0, 0)
    client.flush()
    world.settle()
    assert only(world.take()).info == {"fine": {1: 2}}
    assert [record.message for record in caplog.records] == [
        "a: 0 of the env's info can't be sent and is left out"
    ]


def test_extras_are_sent_to_a_client_that_reads_them() -> None:
    """Columns of the policy reach the env; those that can't be sent are dropped."""
    server = ServerSessions("srv")
    session = ClientSession(meta(), "a", reads_extras=True, free_actions=True)
    session.connected()
    server.receive(b"r", session.outbox.popleft())
    session.receive(server.outbox.popleft().parts)
    session.finish(0, EnvRet(env_id="e", observation=np.zeros(3)))
    server.receive(b"r", session.outbox.popleft())
    chunk = {"chunk": np.ones((4, 2)), "mode": "fast"}
    server.step("a", 1, chunk, {"log_prob": -0.5, "net": object()}, 0.0)
    event = session.receive(server.outbox.popleft().parts)
    assert np.array_equal(event.action["chunk"], chunk["chunk"])
    assert event.action["mode"] == "fast"
    assert event.extras == {"log_prob": -0.5}


@pytest.mark.parametrize("stray", [Welcome(env_id="x"), Refusal(text="no", retry=False)])
def test_a_second_answer_to_a_hello_ends_the_session(world: World, stray: Any) -> None:
    """So does a second hello."""
    client = world.clients["a"]
    client.receive(Writer().write(stray))
    assert client.ended
    other = world.clients["b"]
    other.session.connected()
    other.flush()
    world.settle()
    assert other.refused or other.ended
