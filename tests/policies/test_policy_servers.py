"""The client of openpi's policy server: answers, errors, and servers that misbehave."""

from __future__ import annotations

import logging
import socket
import threading
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from patience import HANG
from policies.counting import QUEUE, check, evaluated, group_of
from policies.servers import OpenPiServer, packed, send_chunk, serving
from websockets.sync.client import connect

import rlightning_aio as rl
from rlightning_aio.collecting import Collector
from rlightning_aio.errors import PolicyServerError
from rlightning_aio.plugins import openpi
from rlightning_aio.plugins.openpi import OpenPiPolicy
from rlightning_aio.policies import ActionChunks

if TYPE_CHECKING:
    from collections.abc import Callable

    from websockets.sync.server import ServerConnection


# -- right answers ------------------------------------------------------------------------


def test_chunks_of_an_openpi_server_are_played() -> None:
    """It gets the observation and the instruction of the episode."""
    server = OpenPiServer()
    with serving(server) as url, OpenPiPolicy(url) as policy:
        check(evaluated(ActionChunks(policy, 3)))
    seen = {(one["prompt"], *one["observation/state"].tolist()) for one in server.seen}
    asked = {(one.seed, step) for one in QUEUE for step in range(0, one.seed + 4, 3)}
    assert seen == {(f"lift {seed}", seed, step) for seed, step in asked}
    assert server.connections == 1


def test_a_lost_connection_is_an_error_and_the_next_call_connects_again() -> None:
    def answer(connection: Any, observation: dict[str, Any]) -> None:
        if len(server.seen) == 1:
            connection.close()
        else:
            send_chunk(connection, observation)

    server = OpenPiServer(answer)
    with serving(server) as url, OpenPiPolicy(url) as policy:
        with pytest.raises(PolicyServerError, match="has closed the connection in place of an"):
            evaluated(ActionChunks(policy, 3))
        check(evaluated(ActionChunks(policy, 3)))
    assert server.connections == 2


def test_what_is_sent_can_be_chosen(caplog: pytest.LogCaptureFixture) -> None:
    """Arrays of any number type, texts and nested maps; the key is sent along, and not logged."""
    caplog.set_level(logging.DEBUG)
    keys: list[Any] = []

    def answer(connection: Any, observation: dict[str, Any]) -> None:
        keys.append(connection.request.headers["Authorization"])
        send_chunk(connection, {"observation/state": observation["nested"]["state"]})

    def observe(observation: Any, info: dict[str, Any]) -> dict[str, Any]:
        image = np.full((4, 6, 3), 7, np.uint8)[:, ::2]
        more = {"image": image, "gripper": np.float32(0.5), "n": np.int64(3), "ok": np.bool_(True)}
        return {"nested": {"state": observation}, "prompt": info["task_description"], **more}

    server = OpenPiServer(answer)
    with serving(server) as url, OpenPiPolicy(url, observe, api_key="abc") as policy:
        check(evaluated(ActionChunks(policy, 3)))
    assert set(keys) == {"Api-Key abc"}
    ours = [record for record in caplog.records if record.name != "websockets.server"]
    assert not any("Api-Key abc" in record.getMessage() for record in ours)
    assert server.seen[0]["image"].shape == (4, 3, 3)
    assert (server.seen[0]["image"] == 7).all()
    assert [server.seen[0][key] for key in ("gripper", "n", "ok")] == [0.5, 3, True]


def test_an_end_does_not_hide_what_the_reset_has_said() -> None:
    """A collector asks for the action of such a result, too, which its env ignores."""

    def observe(observation: Any, info: dict[str, Any]) -> dict[str, Any]:
        return {"observation/state": observation, "prompt": info["task_description"]}

    server = OpenPiServer(lambda connection, _: connection.send(packed({"actions": [[0, 0, 0]]})))
    with serving(server) as url, OpenPiPolicy(url, observe) as policy, group_of() as group:
        Collector(group, ActionChunks(policy), num_transitions=9, seed=0).collect()


# -- servers that are wrong ---------------------------------------------------------------


def test_a_server_that_starts_late_is_waited_for() -> None:
    """Connections are refused until it listens."""
    with socket.create_server(("127.0.0.1", 0)) as unused:
        port = unused.getsockname()[1]
    refused = threading.Event()
    with OpenPiPolicy(f"ws://127.0.0.1:{port}") as policy:
        found: list[Any] = []

        def evaluating() -> None:
            refused.set()
            found.append(evaluated(ActionChunks(policy, 3)))

        thread = threading.Thread(target=evaluating)
        thread.start()
        refused.wait()
        with serving(OpenPiServer(), port):
            thread.join()
    check(found[0])


@pytest.mark.parametrize("listens", [False, True])
def test_a_server_that_opens_no_connection_is_named(listens: bool) -> None:
    """Once the time for it is over: it is missing, or nobody speaks WebSocket there."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"ws://127.0.0.1:{silent.getsockname()[1]}"
        if not listens:
            silent.close()
        with (
            OpenPiPolicy(url, connect_timeout=0.1, timeout=0.2) as policy,
            pytest.raises(PolicyServerError, match=rf"{url} can't be reached: .*; start it"),
        ):
            evaluated(policy)


@pytest.mark.parametrize("greets", [True, False])
def test_a_silent_server_is_an_error(greets: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the time for an answer; before or after the first frame."""

    def patiently(url: str, **options: Any) -> Any:
        """Connect; on a busy machine, that takes longer than the answer may take here."""
        return connect(url, **{**options, "open_timeout": HANG})

    def handler(connection: Any) -> None:
        if greets:
            connection.send(packed({}))
        for _ in connection:
            pass

    monkeypatch.setattr(openpi, "connect", patiently)
    with (
        serving(handler) as url,
        OpenPiPolicy(url, timeout=0.2) as policy,
        pytest.raises(PolicyServerError, match=r"has not answered in 0.2 s"),
    ):
        evaluated(policy)


def refused(answer: Callable[[ServerConnection, Any], None], match: str) -> None:
    """Check the error of an evaluation with a server that answers like this."""
    server = OpenPiServer(answer)
    refusal = pytest.raises(PolicyServerError, match=match)
    with serving(server) as url, OpenPiPolicy(url) as policy, refusal:
        evaluated(policy)
    assert server.connections == 1


def test_the_error_of_an_openpi_server_is_shown() -> None:
    """It is a text frame, a traceback."""

    def answer(connection: ServerConnection, _: Any) -> None:
        connection.send("Traceback …\nKeyError: 'observation/image'")
        connection.close(1011)

    refused(answer, r"reports an error:\nTrace.*\n.*/image'")


def array_of(**fields: Any) -> bytes:
    good = {"__ndarray__": True, "data": bytes(24), "dtype": "<f8", "shape": [3]}
    return packed({"actions": {k.encode(): v for k, v in {**good, **fields}.items()}})


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (b"", "can't be read"),
        (b"\xc1", "can't be read"),
        (b"\x91" * 100_000, "can't be read"),
        (b"\xdd\xff\xff\xff\xff", "can't be read"),
        (b"\xa1\xff", "can't be read"),
        (b"\xc4\x00", "not a map with"),
        (packed({"action": 1}), r"a map with \['action'\], not one"),
        (packed({"actions": "up"}), "no numbers"),
        (packed({"actions": [[1, 2], [3]]}), "no numbers"),
        (packed({"actions": []}), "no numbers"),
        (array_of(dtype="|O"), "dtype '|O', which is none of numbers"),
        (array_of(dtype="<f8,<f8"), "none of numbers"),
        (array_of(dtype=["<f8"]), "none of numbers"),
        (array_of(shape=[1 << 40]), "can't be read"),
        (array_of(shape="x"), "can't be read"),
        (array_of(data=b"123"), "can't be read"),
        (array_of(data="123"), "can't be read"),
    ],
)  # fmt: skip
def test_a_frame_that_is_no_answer_is_refused(frame: bytes, message: str) -> None:
    """Nothing in it is executed, and no memory is taken for what it only claims to hold."""
    refused(lambda connection, _: connection.send(frame), message)


def test_a_frame_above_the_limit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The connection is closed before it is read."""
    monkeypatch.setattr("rlightning_aio.plugins.openpi._MAX_BYTES", 1000)
    refused(lambda connection, _: connection.send(bytes(1001)), r"1009 \(message too big\)")


@pytest.mark.parametrize("url", ["localhost:8000", "http://localhost", "ws://", "ws://a:b", ""])
def test_a_url_that_is_none_is_refused(url: str) -> None:
    """Before anything is connected."""
    with pytest.raises(rl.ConfigError, match="should look like ws://localhost:8000"):
        OpenPiPolicy(url)


def test_what_can_t_be_sent_is_named() -> None:
    """Objects and texts in arrays."""
    for value in (object(), np.array(["a"]), np.array([None])):
        with (
            OpenPiPolicy("ws://localhost:1", lambda _, info, value=value: {"x": value}) as policy,
            pytest.raises(TypeError, match="can't be sent to a policy server"),
        ):
            evaluated(policy)
