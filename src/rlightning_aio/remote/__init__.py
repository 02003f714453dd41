"""The client's side of env_server: an env that dials in to a trainer elsewhere."""

from __future__ import annotations

from rlightning_aio.remote.client import RemoteEnvClient

__all__ = ["RemoteEnvClient"]
