"""`LeRobotWriter`: a dataset of LeRobot that is written while rollouts are collected.

Rule: a dataset holds whole episodes only (`whole_episodes`), and each is written as it ends. Names
are those that LeRobot's policies expect; `LeRobotPolicy` plays with the same ones.
"""

from __future__ import annotations

import warnings
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np

from rlightning_aio.collecting.episodes import whole_episodes
from rlightning_aio.envs.hardware import signals_held_back
from rlightning_aio.trees import walked

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from rlightning_aio.collecting import Rollout
    from rlightning_aio.collecting.episodes import WholeEpisode

__all__ = ["LeRobotWriter", "named_columns"]

_NAMES: Final = {
    "": "observation.state",
    "agent_pos": "observation.state",
    "pixels": "observation.image",
}


class LeRobotWriter:
    """Writes the whole episodes of rollouts to a LeRobotDataset, a new one or one that exists.

    ::

        with LeRobotWriter("me/pushed", folder, fps=10, task="push the block") as writer:
            for _ in range(100):
                writer.add(collector.collect())

    Columns have the names that LeRobot's policies expect: ``action``, ``observation.state``,
    ``observation.image``, ``observation.images.<camera>``, ``observation.environment_state``.
    ``agent_pos`` is the state, and so is an observation that is one array; ``pixels`` is the image,
    or has one for each camera; other images are cameras. `names` says so of others. Images are
    saved as videos, floats as float32. There are ``next.reward`` and ``next.done``, too.

    Args:
        repo_id: name of the dataset.
        root: its folder. If there is a dataset, episodes are appended to it.
        fps: steps per second.
        task: text of the task.
        names: of columns, by the keys of the observation that lead to them, joined by dots.

    Attributes:
        dataset: LeRobot's; None before the first episode. It can be read after the end.

    Raises:
        ValueError: `names` doesn't fit the observations, the dataset has other columns or another
            `fps`, or, at the end, no whole episode was added.
    """

    dataset: Any = None

    def __init__(
        self,
        repo_id: str,
        root: str | Path,
        *,
        fps: int,
        task: str = "",
        names: Mapping[str, str] | None = None,
    ) -> None:
        self._repo_id, self._root, self._fps = repo_id, Path(root), fps
        self._task, self._names = task, names or {}
        self._begun: dict[int, list[dict[str, Any]]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        """Make the dataset readable, also after a fault or Ctrl-C."""
        if self.dataset is not None:
            with signals_held_back():
                self.dataset.finalize()
        elif kind is None:
            raise ValueError("there was no whole episode to save")

    def add(self, rollout: Rollout) -> None:
        """Write the episodes that end in a rollout; those that don't are continued by the next.

        Args:
            rollout: successive ones of one `Collector`.

        Raises:
            ValueError: see the class; or the envs have several agents or plain values.
        """
        for episode in whole_episodes([rollout], self._begun):
            self._write(self._columns(episode))

    def _columns(self, episode: WholeEpisode) -> dict[str, NDArray[Any]]:
        """Return the columns of an episode by LeRobot's names, a row for each step."""
        given = episode.observation, episode.action
        if any(isinstance(leaf, list) for _, leaf in walked(given)):
            raise ValueError(
                "these episodes hold plain Python values, which are no columns of a LeRobot "
                "dataset; whole_episodes(rollouts) has them"
            )
        columns = {
            **named_columns(episode.observation, self._names),
            "action": episode.action,
            "next.reward": episode.reward,
            "next.done": episode.terminated | episode.truncated,
        }
        return {name: _column(of)[: len(episode)] for name, of in columns.items()}

    def _write(self, columns: dict[str, NDArray[Any]]) -> None:
        if self.dataset is None:
            self.dataset = self._opened({name: _feature(of) for name, of in columns.items()})
        with signals_held_back():  # Half an episode would make the dataset unreadable.
            for step in range(len(columns["next.done"])):
                frame = {name: of[step] for name, of in columns.items()}
                self.dataset.add_frame({**frame, "task": self._task})
            # Processes of its own for each camera would get a Ctrl-C, too.
            self.dataset.save_episode(parallel_encoding=False)

    def _opened(self, features: dict[str, dict[str, Any]]) -> Any:
        kind = import_module("lerobot.datasets.lerobot_dataset").LeRobotDataset
        if not {"observation.state", "observation.environment_state"} & {*features}:
            warnings.warn(
                f"the dataset has no observation.state, which most of LeRobot's policies need, but "
                f"{sorted(features)}: say by names={{…}} which column it is",
                stacklevel=4,
            )
        if not (self._root / "meta" / "info.json").exists():
            return kind.create(self._repo_id, fps=self._fps, features=features, root=self._root)
        found = kind.resume(self._repo_id, root=self._root)
        wanted = {"fps": self._fps, **{name: _kind(of) for name, of in features.items()}}
        there = {name: _kind(of) for name, of in found.features.items()}
        there["fps"] = found.fps
        other = [name for name in wanted if wanted[name] != there.get(name)]
        if other := other or [name for name in there if name not in {*wanted, *_LEROBOTS_OWN}]:
            differ = [f"{name}: {there.get(name)}, not {wanted.get(name)}" for name in other]
            raise ValueError(f"the dataset in {self._root} has {'; '.join(differ)}")
        return found


_LEROBOTS_OWN: Final = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def named_columns(observation: Any, names: Mapping[str, str]) -> dict[str, Any]:
    """Return the arrays of an observation by LeRobot's names; see `LeRobotWriter`.

    Raises:
        ValueError: two have the same name, or one of `names` is not there.
    """
    found: dict[str, Any] = {}
    known: list[str] = []
    for path, column in walked(observation):
        known.append(key := ".".join(map(str, path)))
        name = names.get(key) or _NAMES.get(key) or _default_name(key, column)
        if name in found:
            raise ValueError(f"two columns of the observation would be {name}: say by names={{…}}")
        found[name] = column
    if unknown := [key for key in names if key not in known]:
        raise ValueError(f"names has {unknown}; the observation has {known}")
    return found


def _default_name(key: str, column: NDArray[Any]) -> str:
    if column.dtype == np.uint8 and column.ndim == 4:
        return f"observation.images.{key.removeprefix('pixels.')}"
    return f"observation.{key}"


def _column(array: NDArray[Any]) -> NDArray[Any]:
    """Return rows of one number at least, floats as float32."""
    rows = array.reshape(len(array), 1) if array.ndim == 1 else array
    return rows.astype(np.float32) if rows.dtype.kind == "f" else rows


def _feature(column: NDArray[Any]) -> dict[str, Any]:
    shape = column.shape[1:]
    if column.dtype == np.uint8 and len(shape) == 3:
        return {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"]}
    return {"dtype": str(column.dtype), "shape": shape, "names": None}


def _kind(feature: dict[str, Any]) -> str:
    return f"{feature['dtype']} {tuple(feature['shape'])}"
