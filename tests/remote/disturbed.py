"""A trainer with an honest client, disturbed by unauthenticated peers."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from patience import HANG

from rlightning_aio import sync
from rlightning_aio.remote.keys import make_keys

if TYPE_CHECKING:
    from collections.abc import Iterator

_TESTS = Path(__file__).parents[1]


@contextmanager
def disturbed(*, curve: bool, messages: int) -> Iterator[tuple[Any, Any, subprocess.Popen[str]]]:
    """Yield a group with one CartPole client, its listener, and the process of the peers.

    Args:
        curve: the env_server has keys, and the peers have none that it knows.
        messages: number of messages of the peers, which then end.
    """
    with tempfile.TemporaryDirectory() as directory:
        kwargs: dict[str, Any] = {"connect_timeout": HANG, "heartbeat": 5.0}
        keys: list[str] = []
        if curve:
            (arm,) = make_keys(directory, ["arm"])
            keys, kwargs["keys"] = [str(arm)], str(Path(directory) / "server")
        entry = {"name": "robots", "backend": "env_server", "env_kwargs": kwargs}
        with sync.build_env_group(entry) as group:
            address = group["robots-0"].address
            client = _start("client_processes.py", address, "1", "CartPole-v1", *keys)
            try:
                group.reset()
                mode = ["curve"] if curve else []
                peers = _start("unauthenticated_peers.py", address, str(messages), *mode)
                try:
                    yield group, group["robots-0"]._server._listener, peers
                finally:
                    peers.kill()
                    peers.wait()
                    peers.stdout.close()
            finally:
                client.terminate()
                client.wait()
                client.stdout.close()


def _start(script: str, *arguments: str) -> Any:
    return subprocess.Popen(
        [sys.executable, str(_TESTS / "remote" / script), *arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(_TESTS), *sys.path])},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
