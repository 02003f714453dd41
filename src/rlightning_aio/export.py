"""Episodes of rollouts as datasets of Minari and of LeRobot.

Rule: a dataset holds whole episodes. `EpisodeJoiner` puts them together from rollouts, which may
cut them anywhere, and leaves out those that were lost with a worker.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio.batch.stacking import concatenated
from rlightning_aio.protocol.columns import mapped

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from rlightning_aio.collecting import Rollout

__all__ = ["EpisodeJoiner", "WholeEpisode", "save_lerobot", "save_minari"]

_LEROBOT_NAMES = {
    "agent_pos": "observation.state",
    "environment_state": "observation.environment_state",
    "pixels": "observation.image",
}
_CAMERAS = "observation.images"


@dataclass(frozen=True, slots=True)
class WholeEpisode:
    """An episode from its reset to its end, of T steps.

    Attributes:
        observation: ``[T + 1, *obs]``, the first one from the reset; of Dict and Tuple spaces a
            dict or tuple of such arrays.
        action: ``[T, *action]``, likewise.
        reward: ``[T]`` float32.
        terminated, truncated: ``[T]``; the last of either is True.
    """

    observation: Any
    action: Any
    reward: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]

    def __len__(self) -> int:
        """Number of steps."""
        return len(self.reward)


class EpisodeJoiner:
    """Joins the transitions of successive rollouts of one `Collector` to episodes."""

    def __init__(self) -> None:
        self._open: dict[int, list[dict[str, Any]]] = {}
        """Parts of the episode that each env has begun."""

    def add(self, rollout: Rollout) -> list[WholeEpisode]:
        """Return the episodes that a rollout completes, in arrays of their own.

        Raises:
            ValueError: the envs have several agents.
        """
        if isinstance(rollout.done, dict):
            raise ValueError("episodes of several agents can't be exported")
        done, first = rollout.done.reshape(-1), rollout.first.reshape(-1)
        ends = {int(position): k for k, position in enumerate(rollout.ends)}
        lengths: dict[int, list[int]] = {}
        for ended in rollout.episodes:
            lengths.setdefault(ended.index, []).append(ended.length)
        found: list[WholeEpisode] = []
        for index, rows in _segments(rollout, ends):
            if first[rows[0]]:
                self._open[index] = []
            parts = self._open.setdefault(index, [])
            parts.append(_part(rollout, rows))
            if done[rows[-1]]:
                end = ends[int(rows[-1])]
                last = mapped(lambda leaf, k=end: leaf[k : k + 1].copy(), rollout.end_observation)
                episode = _joined(self._open.pop(index), last)
                # Shorter if its begin is in no rollout, or a replaced worker resumed it.
                if len(episode) == lengths[index].pop(0):
                    found.append(episode)
        return found


def _segments(rollout: Rollout, ends: dict[int, int]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Yield the rows of each env up to each end, in order."""
    of_rows = rollout.index.reshape(-1)
    for index in np.unique(of_rows).tolist():
        rows = np.flatnonzero(of_rows == index)
        stops = [k + 1 for k, row in enumerate(rows.tolist()) if row in ends]
        yield from ((index, part) for part in np.split(rows, stops) if len(part))


def _part(rollout: Rollout, rows: NDArray[np.intp]) -> dict[str, Any]:
    size, axes = len(rollout), len(rollout.shape)
    return {
        name: mapped(lambda leaf: leaf.reshape(size, *leaf.shape[axes:])[rows], rollout[name])
        for name in ("observation", "action", "reward", "terminated", "truncated")
    }


def _joined(parts: list[dict[str, Any]], last: Any) -> WholeEpisode:
    columns = {name: [part[name] for part in parts] for name in parts[0]}
    columns["observation"].append(last)
    return WholeEpisode(**{name: concatenated(trees) for name, trees in columns.items()})


# -- Minari -------------------------------------------------------------------------------


def save_minari(
    episodes: Iterable[WholeEpisode],
    dataset_id: str,
    observation_space: Any,
    action_space: Any,
    **fields: Any,
) -> Any:
    """Save episodes as a dataset of Minari, and return it (``pip install 'minari[hdf5]'``).

    Args:
        episodes: such as `EpisodeJoiner.add` returns.
        dataset_id: such as ``cartpole/random-v0``. The folder is Minari's own
            (``MINARI_DATASETS_PATH``).
        observation_space: such as ``group.get_observation_spaces()[0]``.
        action_space: likewise.
        fields: further arguments of `minari.create_dataset_from_buffers`, such as ``env``.
    """
    buffer_of = import_module("minari.data_collector").EpisodeBuffer
    buffers = [
        buffer_of(
            id=number,
            observations=episode.observation,
            actions=episode.action,
            rewards=episode.reward,
            terminations=episode.terminated,
            truncations=episode.truncated,
        )
        for number, episode in enumerate(episodes)
    ]
    return import_module("minari").create_dataset_from_buffers(
        dataset_id, buffers, observation_space=observation_space, action_space=action_space,
        **fields,
    )  # fmt: skip


# -- LeRobot ------------------------------------------------------------------------------


def save_lerobot(
    episodes: Iterable[WholeEpisode], repo_id: str, root: str | Path, *, fps: int, task: str = ""
) -> Any:
    """Save episodes as a LeRobotDataset, and return it.

    Features have LeRobot's names: ``agent_pos`` is ``observation.state``, and so is an observation
    that is one array; ``pixels`` is ``observation.image``, saved as a video, or
    ``observation.images.<camera>``; others are ``observation.<name>``. Floats become float32.

    Args:
        episodes: such as `EpisodeJoiner.add` returns; one at least.
        repo_id: name of the dataset.
        root: a folder that doesn't exist yet.
        fps: steps per second.
        task: text of the task.

    Raises:
        ValueError: there is no episode.
    """
    frames = [_frames(episode) for episode in episodes]
    if not frames:
        raise ValueError("there is no episode to save")
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
