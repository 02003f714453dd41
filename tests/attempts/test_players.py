"""Which envs of a group are there to play."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import pytest
from kit.counting import ClientThread, CountingEnv, look, served
from patience import HANG

from rlightning_aio import sync
from rlightning_aio.attempts.players import Players
from rlightning_aio.attempts.queue import AttemptQueue
from rlightning_aio.attempts.rules import Rules

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rlightning_aio import BatchedData


def until_it_is(state: str, group: Any) -> None:
    until = time.monotonic() + HANG
    while group.get_workers()[0]["state"] != state:
        assert time.monotonic() < until
        look(group)


@pytest.fixture
def group() -> Iterator[sync.EnvGroup]:
    """A place for one client."""
    with sync.build_env_group(served()) as group:
        yield group


def dial(group: sync.EnvGroup, *, hardware: bool) -> ClientThread:
    return ClientThread(group["robots-0"].address, "a", CountingEnv(), hardware=hardware)


def leave(group: sync.EnvGroup, client: ClientThread, batch: BatchedData) -> None:
    """Let a client leave once it has answered a step, so that it is lost while it is idle."""
    client.env.on_step = lambda: setattr(client.env, "finished", True)
    group.step(batch.respond(action=[[0.0, 0.0]]))
    client.join()
    until_it_is("empty", group)


def test_a_place_whose_client_has_left_while_it_was_idle_is_free_no_more(
    group: sync.EnvGroup, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Looking takes its time, so it is done now and then, or at once where nothing else is left."""
    monkeypatch.setattr("rlightning_aio.attempts.queue.LOOK_SECONDS", 1e6)
    client = dial(group, hardware=False)
    batch, _ = group.reset()
    queue = AttemptQueue(group, Rules())
    assert [*queue.free] == ["robots-0/0"]
    leave(group, client, batch)
    queue.look()
    assert not queue.free
    client = dial(group, hardware=False)
    until_it_is("up", group)
    queue.busy.add("robots-0/0")
    queue.look(at_once=True)
    assert not queue.free
    queue.release("robots-0/0")
    assert [*queue.free] == ["robots-0/0"]
    assert [*queue.free] == ["robots-0/0"]
    group.reset()  # A client that has not read its welcome has no session that could end.
    group.close()
    client.join()


def test_what_moves_something_real_and_was_lost_is_left_alone_until_its_user_resets_it(
    group: sync.EnvGroup,
) -> None:
    """It was lost while it was idle, and came back."""
    client = dial(group, hardware=True)
    batch, _ = group.reset()
    assert Players(group).present == {"robots-0/0"}
    leave(group, client, batch)
    client = dial(group, hardware=True)
    until_it_is("up", group)
    assert not Players(group).present
    assert client.env.resets == 0
    group.reset()
    assert Players(group).present == {"robots-0/0"}
    group.close()
    client.join()
