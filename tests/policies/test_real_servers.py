"""Clients against the code of the two projects: openpi's codec, and vla-eval's own server."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from policies.counting import QUEUE, check, chunk_of, group_of
from policies.servers import serving

from rlightning_aio.errors import PolicyServerError
from rlightning_aio.evaluation import evaluate
from rlightning_aio.plugins.policy_servers import OpenPiPolicy, VlaEvalPolicy
from rlightning_aio.policies import ActionChunks

if TYPE_CHECKING:
    from collections.abc import Iterator

TESTS = Path(__file__).parents[1]

pytestmark = pytest.mark.simulators


def evaluated(policy: Any, **kwargs: Any) -> Any:
    with group_of(3) as group, group.auto_reset(100):
        return evaluate(group, policy, QUEUE, **kwargs)


def test_openpi_s_codec_reads_and_writes_the_frames() -> None:
    """The loop around it is that of openpi's WebsocketPolicyServer."""
    codec = pytest.importorskip("openpi_client.msgpack_numpy")
    prompts: set[str] = set()

    def handler(connection: Any) -> None:
        connection.send(codec.packb({"reset_pose": np.zeros(6)}))
        for frame in connection:
            observation = codec.unpackb(frame)
            prompts.add(observation["prompt"])
            actions = chunk_of(observation["observation/state"])
            timing = {"infer_ms": np.float64(3.5)}
            connection.send(codec.packb({"actions": actions, "server_timing": timing}))

    with serving(handler) as url, OpenPiPolicy(url) as policy:
        check(evaluated(ActionChunks(policy, 3)))
    assert prompts == {f"lift {one.seed}" for one in QUEUE}


@contextlib.contextmanager
def serving_vla_eval(**options: Any) -> Iterator[tuple[str, list[str]]]:
    """Yield the URL, and the sizes of its batches when it has ended."""
    pytest.importorskip("vla_eval")
    sizes: list[str] = []
    process = subprocess.Popen(
        [sys.executable, TESTS / "policies" / "vla_eval_server.py", json.dumps(options)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS), *sys.path])},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    with process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            yield f"ws://127.0.0.1:{int(process.stdout.readline())}", sizes
        finally:
            process.stdin.close()
            sizes += process.stdout.read().split()


@pytest.mark.parametrize("options", [{}, {"chunk_size": 3}, {"chunk_size": 3, "max_batch_size": 3}])
def test_vla_eval_s_server_plays_chunks_or_returns_them(options: dict[str, Any]) -> None:
    """Its batches are made of the envs that are ready together."""
    with serving_vla_eval(**options) as (url, sizes), VlaEvalPolicy(url) as policy:
        chosen = policy if options else ActionChunks(policy, 3)
        check(evaluated(chosen, min_results=3))
    assert ("max_batch_size" in options) == (max(map(int, sizes)) > 1)


def test_an_error_of_vla_eval_s_server_is_shown() -> None:
    """It reports it in a frame."""
    with (
        serving_vla_eval(broken=True) as (url, _),
        VlaEvalPolicy(url) as policy,
        pytest.raises(PolicyServerError, match="observation_failed: KeyError: 'images'"),
    ):
        evaluated(policy)
