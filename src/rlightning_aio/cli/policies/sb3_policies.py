"""Policies from files saved by Stable-Baselines3, which is imported on first use.

Such a file holds pickles that can execute any code in this process, so it must be trusted as code.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import json
import zipfile
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.errors import ConfigError
from rlightning_aio.policies.predicting import PredictPolicy

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import gymnasium as gym

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.types import EnvMeta

__all__ = ["SB3Policy", "digest_of"]

_BY_MODULE: Final = {"dqn": "DQN", "sac": "SAC", "td3": "TD3"}
"""Algorithms by the module of their policies; DDPG uses TD3's."""


class SB3Policy:
    """A policy that returns the deterministic actions of a model's `predict`.

    Args:
        path: the file of the model.
        algorithm: such as ``PPO``; None finds it in the file.

    Raises:
        ConfigError: the file is missing, or is no model of the algorithm.
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
        except Exception as error:  # Unpickling may raise anything.
            words = f"{type(error).__name__}: {error}"
            raise ConfigError(f"--policy {path}: can't be loaded as {name}: {words}") from error
        self._predict = PredictPolicy(self._model)

    def check(self, metas: Sequence[EnvMeta]) -> None:
        """Check that the model was trained on envs with these spaces.

        Raises:
            ConfigError: it was not; the message names the env.
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
        return self._predict(batch)


def _size(space: Any, num_envs: int) -> Any:
    """Return a value that is equal for compatible spaces; images may be transposed."""
    if space is None or space.shape is None:
        return type(space).__name__
    return sorted(space.shape[1:] if num_envs > 1 else space.shape)


def _algorithm_in(path: Path) -> str:
    """Return the algorithm of a saved model, as found in its file."""
    unknown = ConfigError(
        f"--policy {path}: the algorithm of Stable-Baselines3 can't be found in it; name it "
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
    """Return the SHA-256 of a file, which identifies a model."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
