"""Policies from files that Stable-Baselines3 has saved; it is imported when one is asked for.

Such a file holds pickles, which can have this process execute anything: it is trusted as code is.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import json
import zipfile
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.errors import ConfigError
from rlightning_aio.protocol.columns import mapped

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import gymnasium as gym

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.types import EnvMeta

__all__ = ["SB3Policy", "digest_of"]

_BY_MODULE: Final = {"dqn": "DQN", "sac": "SAC", "td3": "TD3"}
"""The algorithm whose policies a module has; DDPG's are TD3's, and act alike."""


class SB3Policy:
    """What a model's `predict` says, its likeliest actions.

    Args:
        path: of the file.
        algorithm: such as ``PPO``; None reads it from the file.

    Raises:
        ConfigError: the file isn't there, or is no model of that algorithm.
    """

    def __init__(self, path: Path, algorithm: str | None) -> None:
        self._path = path
        if not path.is_file():
            raise ConfigError(f"--policy {path}: there is no such file")
        name = (algorithm or _algorithm_in(path)).upper()
        if importlib.util.find_spec("stable_baselines3") is None:
            raise ConfigError(
                f"--policy {path}: needs Stable-Baselines3: pip install 'rlightning-aio[sb3]'"
            )
        kind: Any = getattr(importlib.import_module("stable_baselines3"), name, None)
        if kind is None or not hasattr(kind, "load"):
            raise ConfigError(f"--algo {name}: Stable-Baselines3 has no such algorithm")
        try:
            self._model: Any = kind.load(path, device="cpu")
        except Exception as error:  # Whatever pickles raise.
            words = f"{type(error).__name__}: {error}"
            raise ConfigError(f"--policy {path}: can't be loaded as {name}: {words}") from error

    def check(self, metas: Sequence[EnvMeta]) -> None:
        """See that the model was trained on such envs.

        Raises:
            ConfigError: it wasn't; naming the env.
        """
        for meta in metas:
            for what in ("observation", "action"):
                own: gym.Space[Any] = getattr(self._model, f"{what}_space")
                found: gym.Space[Any] | None = getattr(meta, f"{what}_space")
                if _size(own, 1) != _size(found, meta.num_envs):
                    raise ConfigError(
                        f"--policy {self._path}: its {what}s are {own}, and those of env "
                        f"{meta.env_id!r} are {found}"
                    )

    def __call__(self, batch: BatchedData) -> Any:
        head = batch.is_reset.shape
        observation = mapped(
            lambda leaf: leaf.reshape(-1, *leaf.shape[len(head) :]), batch.observation
        )
        actions, _ = self._model.predict(observation, deterministic=True)
        return np.reshape(actions, (*head, *actions.shape[1:]))


def _size(space: Any, num_envs: int) -> Any:
    """What two spaces that suit each other have in common; images may be transposed."""
    if space is None or space.shape is None:
        return type(space).__name__
    return sorted(space.shape[1:] if num_envs > 1 else space.shape)


def _algorithm_in(path: Path) -> str:
    """The algorithm that has saved a model, as far as its file tells."""
    unknown = ConfigError(
        f"--policy {path}: doesn't say which algorithm of Stable-Baselines3 saved it; name it "
        "with --algo"
    )
    try:
        with zipfile.ZipFile(path) as archive:
            data = json.loads(archive.read("data"))
        module = str(data["policy_class"]["__module__"]).split(".")
    except (zipfile.BadZipFile, KeyError, TypeError, ValueError):
        raise unknown from None
    if module[:1] != ["stable_baselines3"]:
        raise unknown
    if module[1] == "common":  # PPO and A2C have the same policies.
        return "PPO" if "clip_range" in data else "A2C"
    if module[1] not in _BY_MODULE:
        raise unknown
    return _BY_MODULE[module[1]]


def digest_of(path: Path) -> str:
    """Tells one model from another that was saved under the same name."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
