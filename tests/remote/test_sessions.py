"""The rules of sessions, one by one, without a network."""

from __future__ import annotations

import logging
from typing import Any

import gymnasium as gym
import msgspec
import numpy as np
import pytest
from remote.unreliable import HEARTBEAT, OBSERVATION, Client, World

from rlightning_aio.errors import BadAction, EnvBusy, UnknownEnv
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.protocol.net import client_registry
from rlightning_aio.protocol.net.client_session import ClientSession, Ended, Phase, Refused
from rlightning_aio.protocol.net.payload import ResultFields
from rlightning_aio.protocol.net.server_session import ServerSessions
from rlightning_aio.protocol.net.wire import MAX_NESTING, ClientHello, Welcome, Writer
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
    """The message says who is here."""
    with pytest.raises(UnknownEnv, match="no client named 'c' has joined srv; joined are 'a', 'b'"):
        world.submit("c", 1)


def test_an_action_that_does_not_fit_is_not_sent(world: World) -> None:
    """The client stays free for a better one."""
    with pytest.raises(BadAction, match=r"srv/a.*expected shape \(2,\)"):
        world.server.requests.step("a", 1, np.zeros(3, np.float32), {}, 0.0)
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


def test_a_lost_request_and_a_lost_result_are_made_good_by_the_next_ping(world: World) -> None:
    """Whichever way the message was lost, the request is executed once."""
    world.take()
    client = world.clients["a"]
    world.submit("a", 1)
    client.inbox.clear()
    world.pass_time(HEARTBEAT / 8)
    world.settle()
    assert only(world.take()).observation[2] == 1
    world.submit("a", 2)
    world.to_client(client)
    client.execute()
    client.outbox.clear()
    world.pass_time(HEARTBEAT / 8)
    world.settle()
    assert only(world.take()).observation[2] == 2


def test_a_repeated_request_gets_the_same_reply_and_an_older_one_is_refused(world: World) -> None:
    """The env steps once for each request."""
    world.take()
    client = world.clients["a"]
    for number in (1, 2):
        world.submit("a", number)
        world.to_client(client)
        client.execute()
        world.to_server(client)
    world.replay(client, 0, to_server=False)
    world.replay(client, 1, to_server=False)
    again, refused = client.outbox
    assert again == world.delivered["a", True][-1]
    assert b"StaleRequest" in refused[0]
    assert client.steps == 2
    world.settle()
    assert len(world.take()) == 2


def test_a_client_that_dies_in_a_step_leaves_one_marked_result(world: World) -> None:
    """Truncated, at its last observation, with the cause."""
    world.take()
    world.submit("a", 1)
    world.clients["a"].kill()
    while "a" in world.server.clients:
        world.pass_time(HEARTBEAT / 8)
        assert world.clock.now <= HEARTBEAT
    result = only(world.take())
    assert (result.number, result.truncated, result.terminated) == (1, True, False)
    assert result.observation.tolist() == [1, 1, 0]
    assert "connection broke" in result.info["client_lost"]


def test_a_request_to_a_client_that_is_known_to_be_absent_is_not_answered(world: World) -> None:
    """There is no series of marked results: the next result is the client's first one."""
    world.submit("a", 1)
    world.clients["a"].kill()
    world.pass_time(HEARTBEAT)
    world.pass_time(HEARTBEAT)
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
    world.pass_time(HEARTBEAT)
    world.pass_time(HEARTBEAT)
    world.settle()
    assert not world.take(), "the first result waits until the loss is reported"
    assert world.submit("a", 1)
    assert "client_lost" in only(world.take()).info
    assert world.submit("a", 2)
    result = only(world.take())
    assert (result.number, result.observation.tolist()) == (2, [1, 2, 0])


def test_a_reset_replaces_a_loss_and_a_first_result(world: World) -> None:
    """After a reset, the end of the last episode does not matter."""
    assert world.submit_reset("a", 1)
    world.settle()
    results = world.take()
    assert [r.number for r in results if r.client == "a"] == [None, 1]
    world.clients["a"].kill()
    world.clients["a"].connect()
    world.settle()
    world.pass_time(2 * HEARTBEAT)
    world.pass_time(HEARTBEAT)
    world.settle()
    assert world.submit_reset("a", 2)
    world.settle()
    assert only(world.take()).number == 2


def test_a_broken_connection_is_resumed_within_a_quarter_of_the_heartbeat(world: World) -> None:
    """The session continues, and the pending request is executed once."""
    world.take()
    client = world.clients["a"]
    world.submit("a", 1)
    world.to_client(client)
    client.execute()
    client.cut()
    world.pass_time(HEARTBEAT / 8)
    client.connect()
    world.settle()
    assert only(world.take()).observation.tolist() == [1, 1, 1]
    assert not client.ended


def test_a_client_gives_its_server_up_after_a_quarter_of_the_heartbeat(world: World) -> None:
    """Then the env must be made safe, and another session begins."""
    client = world.clients["a"]
    client.cut()
    world.clock.now += HEARTBEAT / 4
    client.tick()
    assert client.ended == ["the connection to the server broke and did not come back"]
    client.connect()
    world.settle()
    assert client.session.phase is Phase.SERVING
    assert world.clients["a"].steps == 0


def test_an_idle_client_that_falls_silent_is_given_up_within_the_heartbeat(world: World) -> None:
    """Even if its connection seems intact."""
    world.take()
    while "a" in world.server.clients:
        world.pass_time(HEARTBEAT / 8)
        world.clients["a"].inbox.clear()
        world.clients["a"].outbox.clear()
        world.settle()
        assert world.clock.now <= 1.3 * HEARTBEAT
    assert "b" in world.server.clients


def test_a_busy_client_may_be_silent_without_limit(world: World) -> None:
    """A step may take hours; the connection shows that the client lives."""
    world.take()
    client = world.clients["a"]
    world.submit("a", 1)
    world.to_client(client)
    for _ in range(100):
        world.pass_time(HEARTBEAT)
    client.execute()
    world.settle()
    assert only([r for r in world.take() if r.client == "a"]).number == 1


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
    assert world.clock.now <= 4.0
    assert "no result of a step within 3.0 s" in only(world.take()).info["client_lost"]
    client.execute()
    world.settle()
    assert any("within 3.0 s" in cause for cause in client.ended)


def test_a_client_that_leaves_sends_a_reason(world: World) -> None:
    """Its reason is in the marked result."""
    world.take()
    world.submit("a", 1)
    client = world.clients["a"]
    client.session.leave("battery empty")
    client.flush()
    world.to_server(client)
    assert "it left: battery empty" in only(world.take()).info["client_lost"]


def leave(world: World, client: Client) -> None:
    """Let the client send a goodbye and disconnect."""
    client.session.leave("enough")
    client.flush()
    world.to_server(client)
    client.kill()


def test_a_client_that_leaves_before_the_trainer_saw_it_may_come_back() -> None:
    """There is no loss to report, because no request would report it."""
    world = World("a")
    client = world.clients["a"]
    client.connect()
    world.to_server(client)
    world.to_client(client)
    client.execute()
    client.session.leave("enough")
    client.flush()
    for parts in client.outbox:  # Both have arrived when the trainer reads.
        world.server.receive(client.route or b"", None, parts, 0.0)
    client.outbox.clear()
    world.flush()
    assert not world.take()
    client.kill()
    client.connect()
    world.settle()
    assert only(world.take()).observation.tolist() == [1, 2, 0]


def test_a_client_that_was_dismissed_for_lack_of_room_may_come_back(world: World) -> None:
    """Its first result is reported as if it had never been there."""
    world.take()
    world.server.dismiss("a", "no place")
    world.flush()
    world.settle()
    world.pass_time(1.0)
    world.settle()
    assert world.clients["a"].ended == ["the server ended the session: no place"]
    assert only(world.take()).number is None


def test_the_client_that_left_first_is_forgotten_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """If others need records, the order in which clients left decides, not that of joining."""
    monkeypatch.setattr(client_registry, "_MAX_RECORDS", 2)
    world = World("abc")
    early, late, other = world.clients.values()
    for client in (early, late):
        client.connect()
        world.settle()
    for client in (late, early):
        leave(world, client)
    other.connect()
    world.settle()
    assert world.serving("c")
    with pytest.raises(UnknownEnv, match="'b' has joined"):
        world.submit("b", 1)
    assert world.submit("a", 2)


def test_an_unreported_loss_is_forgotten_last(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A reported one makes room before it, however recent it is."""
    monkeypatch.setattr(client_registry, "_MAX_RECORDS", 2)
    world = World("abc")
    unreported, reported, other = world.clients.values()
    for client in (unreported, reported):
        client.connect()
        world.settle()
    leave(world, unreported)
    world.submit("b", 1)
    leave(world, reported)
    world.take()
    other.connect()
    world.settle()
    assert world.serving("c")
    world.take()
    assert world.submit("a", 2)
    assert "it left: enough" in only(world.take()).info["client_lost"]


def test_a_second_client_of_a_name_waits_until_the_first_is_gone(world: World) -> None:
    """The present client keeps its session."""
    second = Client("a", 9, world.clock)
    second.routes = iter(range(50, 60))
    first, world.clients["a"] = world.clients["a"], second
    second.connect()
    world.to_server(second)
    world.to_client(second)
    assert second.session.phase is Phase.GREETING
    assert "a client named 'a' is here already" in (second.session.refusal or "")
    assert first.session.phase is Phase.SERVING
    for _ in range(40):
        # Messages to the first one find no connection.
        world.pass_time(HEARTBEAT / 8)
        world.settle()
    assert second.session.phase is Phase.SERVING


def test_a_restarted_server_gets_its_clients_back() -> None:
    """A new server doesn't know the old session; the client says hello again."""
    world = World("a")
    world.join_all()
    client = world.clients["a"]
    world.server = ServerSessions("srv", heartbeat=HEARTBEAT)
    client.cut()
    client.connect()
    world.settle()
    world.pass_time(1.0)
    world.settle()
    assert client.ended == ["the server ended the session: no such session"]
    assert client.session.phase is Phase.SERVING


def test_a_server_that_closes_says_goodbye(world: World) -> None:
    """Clients end their sessions at once and say hello later."""
    world.server.close("done")
    world.flush()
    world.settle()
    assert world.clients["a"].ended == ["the server closed: done"]
    assert world.clients["a"].session.phase is Phase.GREETING


def meta(**changes: Any) -> EnvMeta:
    fields: dict[str, Any] = {
        "env_id": "env",
        "observation_space": OBSERVATION,
        "action_space": gym.spaces.Discrete(2),
    }
    return EnvMeta(**{**fields, **changes})


@pytest.mark.parametrize(
    ("name", "changes", "code"),
    [
        ("c/d", {}, "name"),
        ("c\n", {}, "name"),
        ("c", {}, "spaces"),  # Differs from the other clients' action space.
        ("c", {"action_space": gym.spaces.Box(-1, 1, (2,)), "num_envs": 2}, "spaces"),
        ("c", {"action_space": gym.spaces.Box(-1, 1, (2,)), "agents": ("x",)}, "spaces"),
    ],
)
def test_a_client_that_does_not_fit_is_refused_for_good(
    world: World, name: str, changes: dict[str, Any], code: str
) -> None:
    """The client receives the reason and gives up."""
    other_client = ClientSession(meta(**changes), name, heartbeat=HEARTBEAT)
    other_client.connected(0.0)
    world.server.receive(b"r", None, other_client.outbox.popleft(), 0.0)
    event = other_client.receive(world.server.outbox.popleft().parts, 0.0)
    assert isinstance(event, Refused)
    assert event.code == code
    assert "c" not in world.server.clients


def test_another_version_is_refused_with_both_versions(world: World) -> None:
    """Neither side guesses."""
    hello = ClientHello(version=9, name="z", nonce=1, observation_space={}, action_space={})
    world.server.receive(b"r", None, Writer().write(hello), 0.0)
    assert b"speaks version 1, not 9" in world.server.outbox.popleft().parts[0]


def test_a_session_accepts_only_the_key_that_opened_it() -> None:
    """A session's number alone is not enough to use it."""
    server = ServerSessions("srv", heartbeat=HEARTBEAT, new_token=lambda: 7)
    session = ClientSession(meta(), "a", heartbeat=HEARTBEAT)
    session.connected(0.0)
    server.receive(b"r", "alice", session.outbox.popleft(), 0.0)
    session.receive(server.outbox.popleft().parts, 0.0)
    session.finish(0, EnvRet(env_id="e", observation=np.zeros(3)))
    result = session.outbox.popleft()
    server.receive(b"s", "mallory", result, 0.0)
    assert not server.take()
    assert server.num_malformed == 1
    server.receive(b"s", "alice", result, 0.0)
    assert server.take()


def answered_once() -> tuple[World, Any, bytes, bytes]:
    """Return a client that has executed a step, and the parts of its unsent result."""
    world = World("a")
    world.join_all()
    world.take()
    client = world.clients["a"]
    world.submit("a", 1)
    world.to_client(client)
    client.execute()
    (header, frame), client.outbox[:] = client.outbox[0], []
    return world, client, header, frame


def test_results_that_never_fit_end_the_session() -> None:
    """After three wrong answers to one request, the client is dismissed."""
    world, client, header, _ = answered_once()
    for _ in range(3):
        assert not world.results
        world.server.receive(client.route or b"", None, [header, b"short"], 0.0)
        world.flush()
    assert "don't fit what it announced" in only(world.take()).info["client_lost"]
    world.settle()
    assert client.ended


def test_answers_that_are_malformed_as_a_whole_end_the_session() -> None:
    """The request is not repeated forever; without a request nothing is counted."""
    world = World("a")
    world.join_all()
    client = world.clients["a"]
    assert client.route
    for _ in range(5):
        world.server.receive(client.route, None, [b"nonsense"], world.clock.now)
    assert world.serving("a")
    world.take()
    world.submit("a", 7)
    for _ in range(2):
        world.server.receive(client.route, None, [b"nonsense"], world.clock.now)
    assert not world.take()
    world.server.receive(client.route, None, [b"nonsense"], world.clock.now)
    world.flush()
    (lost,) = world.take()
    assert lost.is_loss
    assert "its messages don't fit what it announced" in lost.info["client_lost"]


def test_results_that_are_nested_too_deep_end_the_session() -> None:
    """They are malformed, because reading such an info could exhaust the stack."""
    world, client, header, frame = answered_once()
    deep: dict[str, Any] = {}
    for _ in range(MAX_NESTING):
        deep = {"deep": deep}
    for name in ("info", "extra", "info"):
        assert not world.results
        result = {**msgspec.msgpack.decode(header), name: deep}
        parts = [msgspec.msgpack.encode(result), frame]
        world.server.receive(client.route or b"", None, parts, 0.0)
        world.flush()
    assert "nested more than 32 deep" in only(world.take()).info["client_lost"]


def test_a_client_counts_and_drops_malformed_messages(world: World) -> None:
    """A server's mistakes do not end a client."""
    client = world.clients["a"]
    client.receive([b"\xc1"])
    assert client.session.num_malformed == 1
    assert world.submit("a", 1)


def test_a_flood_of_nonsense_is_logged_rarely(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    """All messages are counted, and the log does not fill."""
    with caplog.at_level(logging.WARNING):
        for k in range(1000):
            world.server.receive(b"r", None, [b"\xc1"], 30 * k / 1000)
    assert world.server.num_malformed == 1000
    assert len(caplog.records) == 3


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
    server = ServerSessions("srv", heartbeat=HEARTBEAT)
    session = ClientSession(meta(), "a", heartbeat=HEARTBEAT, reads_extras=True, free_actions=True)
    session.connected(0.0)
    server.receive(b"r", None, session.outbox.popleft(), 0.0)
    session.receive(server.outbox.popleft().parts, 0.0)
    session.finish(0, EnvRet(env_id="e", observation=np.zeros(3)))
    server.receive(b"r", None, session.outbox.popleft(), 0.0)
    chunk = {"chunk": np.ones((4, 2)), "mode": "fast"}
    server.requests.step("a", 1, chunk, {"log_prob": -0.5, "net": object()}, 0.0)
    event = session.receive(server.outbox.popleft().parts, 0.0)
    assert np.array_equal(event.action["chunk"], chunk["chunk"])
    assert event.action["mode"] == "fast"
    assert event.extras == {"log_prob": -0.5}


def test_a_client_ignores_a_welcome_that_answers_no_hello(world: World) -> None:
    """Answers to earlier hellos change nothing."""
    client = world.clients["a"]
    stray = Welcome(nonce=1, session=99, env_id="x", heartbeat=1.0)
    assert client.session.receive(Writer().write(stray), 0.0) is None
    assert world.submit("a", 1)


def test_a_client_that_its_server_forgot_gets_ended(world: World) -> None:
    """`Ended` carries the server's reason."""
    client = world.clients["a"]
    world.server._registry.lose(client_session_of(world, "a"), "test")
    client.cut()
    client.connect()
    world.to_server(client)
    event = client.session.receive(client.inbox.pop(0), 0.0)
    assert isinstance(event, Ended)


def client_session_of(world: World, name: str) -> Any:
    return world.server._registry.records[name].session
