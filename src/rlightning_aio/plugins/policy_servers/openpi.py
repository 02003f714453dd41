"""`OpenPiPolicy`: the client of openpi's policy server.

A connection begins with a map of metadata from the server. Then each observation, a map, is
answered by a map with ``actions``, a chunk ``[horizon, *action]``. A text frame is a traceback.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.plugins.policy_servers.arrays import Codec
from rlightning_aio.plugins.policy_servers.client import PolicyClient, observed
from rlightning_aio.plugins.policy_servers.connection import Address

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio.plugins.one_frame import OneFrame

__all__ = ["OpenPiPolicy"]

_OBSERVED: Final = partial(observed, state="observation/state", instructed="prompt")


class OpenPiPolicy(PolicyClient[bytes]):
    """Asks openpi's policy server (``scripts/serve_policy.py``) for chunks of actions.

    Play them with `ActionChunks`. The server keeps nothing about episodes, so a request whose
    connection is lost is sent again over another one. Close it, or use it in a ``with`` statement.

    Args:
        url: ``ws://host:port`` or ``wss://…``.
        observe: called with the observation of an env and the info of the reset that began its
            episode; returns the map that the server's policy expects, such as
            ``{"observation/image": …, "observation/state": …, "prompt": …}``. None sends a Dict
            observation as it is, any other as ``observation/state``, and the ``task_description``
            or ``task`` of the info as ``prompt``.
        api_key: sent as the header ``Authorization: Api-Key …``.
        timeout: seconds for an answer; the first may take a server minutes.
        connect_timeout: seconds for a server that is not there yet.

    Raises:
        ConfigError: `url` or a time is wrong.
    """

    def __init__(
        self,
        url: str,
        observe: Callable[[Any, dict[str, Any]], dict[str, Any]] | None = None,
        *,
        api_key: str | None = None,
        timeout: float = 300.0,
        connect_timeout: float = 30.0,
    ) -> None:
        headers = {} if api_key is None else {"Authorization": f"Api-Key {api_key}"}
        address = Address(url, timeout, connect_timeout, headers)
        super().__init__(address, Codec(str.encode), observe or _OBSERVED)

    async def _greet(self, connection: OneFrame) -> None:
        # The metadata only describe the policy.
        self._read(await connection.ask())

    def _request(self, observation: Any, begun: dict[str, Any] | None) -> bytes:
        del begun
        return self._codec.encode(observation)

    def _may_repeat(self, request: bytes) -> bool:
        del request
        return True

    async def _exchange(self, connection: OneFrame, request: bytes) -> Any:
        return self._read(await connection.ask(request))

    def _read(self, frame: str | bytes) -> Any:
        if isinstance(frame, str):
            raise self._raised(frame)
        return self._decoded(frame)
