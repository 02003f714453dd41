"""The client's side of env_server: an env that dials in to a trainer elsewhere."""

from __future__ import annotations

from rlightning_aio.remote.client import RemoteEnvClient
from rlightning_aio.remote.keys import make_keys

__all__ = ["RemoteEnvClient", "make_keys"]
