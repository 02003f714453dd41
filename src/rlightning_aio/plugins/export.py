"""Episodes of rollouts as datasets of LeRobot.

Rule: a dataset holds whole episodes only (`whole_episodes`).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio.collecting.episodes import whole_episodes

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    from rlightning_aio.collecting import Rollout
    from rlightning_aio.collecting.episodes import WholeEpisode

__all__ = ["save_lerobot"]

_LEROBOT_NAMES = {
    "agent_pos": "observation.state",
    "environment_state": "observation.environment_state",
    "pixels": "observation.image",
}
_CAMERAS = "observation.images"


def save_lerobot(
    rollouts: Iterable[Rollout], repo_id: str, root: str | Path, *, fps: int, task: str = ""
) -> Any:
    """Save whole episodes of rollouts as a LeRobotDataset, and return it.

    Features have LeRobot's names: ``agent_pos`` is ``observation.state``, and so is an observation
    that is one array; ``pixels`` is ``observation.image``, saved as a video, or
    ``observation.images.<camera>``; others are ``observation.<name>``. Floats become float32.

    Args:
        rollouts: successive ones of one `Collector`, with one whole episode at least; of a list,
            copies (`copy.deepcopy`), because the collector overwrites a rollout in its second call
            of `collect` after it.
        repo_id: name of the dataset.
        root: a folder that doesn't exist yet.
        fps: steps per second.
        task: text of the task.

    Raises:
        ValueError: there is no whole episode, or the envs have several agents.
    """
    frames = [_frames(episode) for episode in whole_episodes(rollouts)]
    if not frames:
        raise ValueError("there is no whole episode to save")
    features = {name: _feature(column) for name, column in frames[0].items()}
    kind = import_module("lerobot.datasets.lerobot_dataset").LeRobotDataset
    dataset = kind.create(repo_id, fps=fps, features=features, root=root)
    for columns in frames:
        for step in range(len(columns["next.reward"])):
            dataset.add_frame({**{name: of[step] for name, of in columns.items()}, "task": task})
        dataset.save_episode()
    dataset.finalize()
    return dataset


def _frames(episode: WholeEpisode) -> dict[str, NDArray[Any]]:
    """Return the columns of an episode by LeRobot's names, a row for each step."""
    seen = {name: of[:-1] for name, of in _named(episode.observation).items()}
    columns = {
        **seen,
        "action": episode.action,
        "next.reward": episode.reward,
        "next.done": episode.terminated | episode.truncated,
    }
    return {name: _column(of) for name, of in columns.items()}


def _named(observation: Any) -> dict[str, NDArray[Any]]:
    if not isinstance(observation, dict):
        return {"observation.state": observation}
    found: dict[str, NDArray[Any]] = {}
    for name, of in cast("dict[str, Any]", observation).items():
        if name == "pixels" and isinstance(of, dict):
            cameras = cast("dict[str, Any]", of)
            found.update({f"{_CAMERAS}.{camera}": frames for camera, frames in cameras.items()})
        else:
            found[_LEROBOT_NAMES.get(name, f"observation.{name}")] = of
    return found


def _column(array: NDArray[Any]) -> NDArray[Any]:
    """Return rows of one number at least, floats as float32."""
    rows = array.reshape(len(array), 1) if array.ndim == 1 else array
    return rows.astype(np.float32) if rows.dtype.kind == "f" else rows


def _feature(column: NDArray[Any]) -> dict[str, Any]:
    shape = column.shape[1:]
    if column.dtype == np.uint8 and len(shape) == 3:
        return {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"]}
    return {"dtype": str(column.dtype), "shape": shape, "names": None}
