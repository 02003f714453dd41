"""The description of the backend ``openenv``, which the trainer reads without websockets."""

from __future__ import annotations

from rlightning_aio.registry import Backend

BACKEND = Backend(
    "openenv",
    "rlightning_aio.plugins.openenv.env:OpenEnv",
    "websockets",
    awaitable=True,
    install="pip install 'rlightning-aio[websockets]'",
    preload=("rlightning_aio.plugins.openenv.env",),
)
