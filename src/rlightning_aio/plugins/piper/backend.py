"""The description of the backend ``piper``, which the trainer reads without the SDK."""

from __future__ import annotations

from rlightning_aio.registry import Backend

BACKEND = Backend(
    "piper",
    "rlightning_aio.plugins.piper.env:PiperEnv",
    "piper_sdk",
    hardware=True,
    install="pip install 'rlightning-aio[piper]'",
)
