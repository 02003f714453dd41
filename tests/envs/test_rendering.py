"""Frames that workers render with MuJoCo's software or GPU drivers, and with pygame."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import pytest

import rlightning_aio as rl
from rlightning_aio import sync

pytest.importorskip("gym_pusht")
pytest.importorskip("gym_aloha")
pytestmark = pytest.mark.simulators

PLACE = os.environ.get("MUJOCO_GL", "")
PIXELS = {"backend": "gymnasium", "env_kwargs": {"obs_type": "pixels"}}
ALOHA = {"task": "gym_aloha:gym_aloha/AlohaTransferCube-v0", **PIXELS}
PUSHT = {"task": "gym_pusht:gym_pusht/PushT-v0", **PIXELS}


def frames(entry: dict[str, Any], **fields: Any) -> Any:
    """Return the frames of a reset and of three steps, ``[4, n, height, width, 3]``."""
    with sync.build_env_group({"name": "arm", **entry, **fields}) as group:
        seeds = [3] * len(group)
        batch, _ = group.reset(seed=seeds)
        space: Any = group.get_action_spaces()[0]
        action = np.stack([(space.low + space.high) / 2] * len(group)).astype(space.dtype)
        found = [frame_of(batch.observation)]
        for _ in range(3):
            batch, _ = group.step(batch.respond(action=action))
            found.append(frame_of(batch.observation))
        return np.stack(found)


def frame_of(observation: Any) -> Any:
    while isinstance(observation, dict):
        observation = observation.get("pixels", next(iter(observation.values())))
    return np.array(observation)


@pytest.mark.skipif(PLACE not in ("egl", "osmesa"), reason="MUJOCO_GL is neither egl nor osmesa")
@pytest.mark.parametrize("entry", [ALOHA, PUSHT], ids=["aloha", "pusht"])
def test_workers_render_what_an_env_in_this_process_does(entry: dict[str, Any]) -> None:
    """Each worker with a context of its own; the frames are pictures, and they change."""
    (inline,) = np.moveaxis(frames(entry, placement="inline"), 1, 0)
    workers = frames(
        entry, num_workers=2, env_vars={"MUJOCO_GL": PLACE, "MUJOCO_EGL_DEVICE_ID": "0"}
    )
    for own in np.moveaxis(workers, 1, 0):
        assert (own == inline).all()
    assert inline.dtype == np.uint8
    assert inline.std() > 10
    assert (inline[0] != inline[-1]).any()


@pytest.mark.skipif(PLACE != "egl", reason="MUJOCO_GL is not egl")
def test_a_worker_renders_on_the_device_of_its_number() -> None:
    """A device that is not there is an error, and named by its variable."""
    devices = {"MUJOCO_GL": "egl", "MUJOCO_EGL_DEVICE_ID": "{process_index}"}
    assert frames(ALOHA, env_vars=devices).std() > 10
    devices["MUJOCO_EGL_DEVICE_ID"] = "9{process_index}"
    with pytest.raises(rl.EnvFault, match=r"MUJOCO_EGL_DEVICE_ID.*got 90"):
        frames(ALOHA, env_vars=devices)
