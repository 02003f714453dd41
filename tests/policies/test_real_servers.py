"""The client against openpi's own codec."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from policies.counting import QUEUE, check, chunk_of, evaluated
from policies.servers import serving

from rlightning_aio.plugins.openpi import OpenPiPolicy
from rlightning_aio.policies import ActionChunks

pytestmark = pytest.mark.simulators


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
        check(evaluated(ActionChunks(policy, 3), 3))
    assert prompts == {f"lift {one.seed}" for one in QUEUE}
