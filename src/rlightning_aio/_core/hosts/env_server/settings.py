"""`ServerSettings`: the ``env_kwargs`` of an env_server entry, checked before anything starts."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from pydantic import AliasChoices, BaseModel, ConfigDict, Field

from rlightning_aio.envs.options import read_options
from rlightning_aio.errors import ConfigError
from rlightning_aio.protocol.net.wire import MAX_HEARTBEAT, MIN_HEARTBEAT
from rlightning_aio.remote.keys import read_server_keys

if TYPE_CHECKING:
    from rlightning_aio.config import EnvConfig

_MAX_PLACES: Final = 1024
_Name = Annotated[str, Field(min_length=1, max_length=128, pattern=r"^[^/\x00-\x1f]+$")]


class ServerSettings(BaseModel):
    """``env_kwargs`` of an env_server entry."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    host: str = "127.0.0.1"
    """Address to listen on; a public one needs ``keys``, or ``insecure: true``."""
    port: int = Field(default=0, ge=0, le=65535, validation_alias=AliasChoices("port", "zmq_port"))
    """Port to listen on; 0 picks a free one."""
    clients: (
        Annotated[int, Field(ge=1, le=_MAX_PLACES)]
        | Annotated[list[_Name], Field(min_length=1, max_length=_MAX_PLACES)]
    ) = Field(default=1, validation_alias=AliasChoices("clients", "num_clients", "min_clients"))
    """Number of places for clients, or the names of the clients that have one."""
    connect_timeout: float = Field(default=60.0, gt=0)
    """Seconds that a call waits for clients alone; ``.inf``: without end."""
    heartbeat: float | None = Field(default=None, ge=MIN_HEARTBEAT, le=MAX_HEARTBEAT)
    """Seconds within which a client that is gone is found; None: 5, of hardware 1."""
    keys: Path | None = None
    """Its directory, made by ``rlightning-aio keygen``; only clients listed there are let in."""
    insecure: bool = False
    """Listen on a public address without keys: any machine that reaches it may be an env."""

    @property
    def places(self) -> list[str]:
        """The name of the client of each place; empty for any."""
        return [""] * self.clients if isinstance(self.clients, int) else self.clients


def place_names(config: EnvConfig) -> list[str]:
    """Return the name of each place of an env_server entry, which ends the id of its env."""
    return [name or str(index) for index, name in enumerate(server_settings(config).places)]


def server_settings(config: EnvConfig) -> ServerSettings:
    """Return the checked ``env_kwargs`` of an env_server entry.

    Raises:
        ConfigError: naming the entry and every wrong field.
    """
    place = f"entry {config.name!r}, env_kwargs"
    settings = read_options(ServerSettings, f"entry {config.name!r}", config.env_kwargs)
    if len({*settings.places} - {""}) < len([name for name in settings.places if name]):
        raise ConfigError(f"{place}.clients: a name is there twice; each has one place")
    if settings.keys is not None:
        read_server_keys(settings.keys)
    if not (_is_loopback(settings.host) or settings.keys or settings.insecure):
        raise ConfigError(
            f"{place}.host: {settings.host!r} can be reached from other machines, and without "
            "keys any of them could pose as an env; set keys (see `rlightning-aio keygen`), "
            "or insecure: true if the network is your own"
        )
    return settings


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
