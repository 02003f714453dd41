"""`LeRobotPolicy`: plays a policy of LeRobot on batches of envs, each at its own step.

Rule: LeRobot's own `select_action` keeps one chunk of actions, and the observations before it, for
a batch of envs that begin their episodes together. Here each env has its own, and the network gets
the envs that have played their chunk.
"""

from __future__ import annotations

from collections import deque
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.plugins.lerobot_dataset import named_columns
from rlightning_aio.policies import ActionChunks
from rlightning_aio.policies.episodes import begins_of_envs

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from rlightning_aio import BatchedData

__all__ = ["LeRobotPolicy"]


class LeRobotPolicy:
    """Plays a `PreTrainedPolicy` of LeRobot, with its action chunks and its observation history.

    Observations get the names that `LeRobotWriter` gives them. The text of the task is
    ``task_description`` or ``task`` in the info of an episode's reset.

    Args:
        policy: one whose `predict_action_chunk` takes observations, such as ACT, diffusion, π0 and
            SmolVLA.
        preprocessor: as LeRobot's `make_pre_post_processors` returns it.
        postprocessor: likewise.
        names: of columns; see `LeRobotWriter`.

    Raises:
        ValueError: `names` doesn't fit the observations.
    """

    def __init__(
        self,
        policy: Any,
        preprocessor: Callable[[dict[str, Any]], dict[str, Any]],
        postprocessor: Callable[[Any], Any],
        *,
        names: Mapping[str, str] | None = None,
    ) -> None:
        config = policy.config
        decay = getattr(config, "temporal_ensemble_coeff", None)
        policy.eval()
        policy.reset()
        self._policy = policy
        self._preprocess, self._postprocess = preprocessor, postprocessor
        self._names = names or {}
        steps = int(config.n_action_steps) if decay is None else None
        self._chunks = ActionChunks(self._predict, steps, temporal_ensemble=decay)
        self._num_seen = int(config.n_obs_steps)
        self._seen: dict[str, deque[dict[str, Any]]] = {}
        """The last observations of each env, if the network gets several."""
        self._tasks: dict[str, str] = {}

    @classmethod
    def from_pretrained(
        cls, path: str | Path, device: str = "cpu", *, names: Mapping[str, str] | None = None
    ) -> LeRobotPolicy:
        """Load a folder that LeRobot saved, or a model of the Hub, with its processors.

        Args:
            path: such as ``outputs/train/…/checkpoints/last/pretrained_model``.
            device: of the network.
            names: of columns; see `LeRobotWriter`.
        """
        factory = import_module("lerobot.policies.factory")
        config = import_module("lerobot.configs.policies").PreTrainedConfig.from_pretrained(path)
        config.device = device
        policy = factory.get_policy_class(config.type).from_pretrained(path, config=config)
        processors = factory.make_pre_post_processors(
            config,
            pretrained_path=str(path),
            preprocessor_overrides={"device_processor": {"device": device}},
        )
        return cls(policy.to(device), *processors, names=names)

    def __call__(self, batch: BatchedData) -> NDArray[Any]:
        """Return the next action of each env."""
        env_ids = batch.env_ids()
        for row in np.flatnonzero(begins_of_envs(batch)).tolist():
            self._seen.pop(env_ids[row], None)
        resets = np.flatnonzero(batch.is_reset).tolist()
        for row, info in zip(resets, batch.take(resets).info() if resets else (), strict=True):
            self._tasks[env_ids[row]] = str(info.get("task_description", info.get("task", "")))
        if self._num_seen > 1:
            self._note(batch)
        return self._chunks(batch)

    def _observed(self, batch: BatchedData) -> dict[str, Any]:
        """Return observations as the network takes them."""
        columns = named_columns(batch.observation, self._names)
        tasks = [self._tasks.get(env_id, "") for env_id in batch.env_ids()]
        tensors = {name: _tensor(column) for name, column in columns.items()}
        return self._preprocess({**tensors, "task": tasks})

    def _note(self, batch: BatchedData) -> None:
        """Keep the last observations of each env; the first one counts for those before it."""
        observed = self._observed(batch)
        for row, env_id in enumerate(batch.env_ids()):
            one = {name: of[row] for name, of in observed.items() if hasattr(of, "dtype")}
            if env_id not in self._seen:
                self._seen[env_id] = deque([one] * self._num_seen, self._num_seen)
            else:
                self._seen[env_id].append(one)

    def _predict(self, batch: BatchedData) -> NDArray[Any]:
        """Return chunks of actions, ``[n, horizon, *action]``."""
        with import_module("torch").inference_mode():
            several = self._num_seen > 1
            observed = self._history(batch.env_ids()) if several else self._observed(batch)
            chunks = self._policy.predict_action_chunk(observed)
            actions = self._postprocess(chunks.flatten(0, 1))
            return actions.reshape(*chunks.shape[:2], *actions.shape[1:]).to("cpu").numpy()

    def _history(self, env_ids: Sequence[str]) -> dict[str, Any]:
        """Stack the last observations of envs, ``[n, observations, …]``."""
        stack = import_module("torch").stack
        return {
            name: stack([stack([one[name] for one in self._seen[env_id]]) for env_id in env_ids])
            for name in self._seen[env_ids[0]][0]
        }


def _tensor(column: NDArray[Any]) -> Any:
    """Return rows as LeRobot's datasets have them: images from 0 to 1, with channels first."""
    if column.ndim == 1:
        column = column[:, None]
    tensor = import_module("torch").from_numpy(np.ascontiguousarray(column)).float()
    is_image = column.dtype == np.uint8 and column.ndim == 4
    return tensor.permute(0, 3, 1, 2).contiguous() / 255 if is_image else tensor
