"""A client that is interrupted while it dials."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
import zmq
from remote.counting import CountingEnv

from rlightning_aio.remote import RemoteEnvClient

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.mark.parametrize(("owner", "name"), [(zmq, "Poller"), (zmq.Socket, "connect")])
def test_an_interrupt_while_dialing_closes_what_is_open(
    owner: object, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The env is closed wherever a signal arrives between the first socket and the last."""
    real: Callable[..., object] = getattr(owner, name)

    def interrupted(*args: object, **kwargs: object) -> object:
        real(*args, **kwargs)
        raise KeyboardInterrupt

    env = CountingEnv()
    client = RemoteEnvClient(env, "127.0.0.1", 9)
    monkeypatch.setattr(owner, name, interrupted)
    with pytest.raises(KeyboardInterrupt), client:
        client.run()
    assert env.closed
