"""The file of ``eval --resume``: the subject of the evaluation, and each finished episode."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.attempts.file import EpisodeFile
from rlightning_aio.evaluation.episodes import Episode, check_numbers
from rlightning_aio.json_text import finite

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rlightning_aio.config import EnvConfig

__all__ = ["EvaluationFile", "queue_subject", "subject"]

_FIELDS: Final = (
    "name", "backend", "task", "num_workers", "num_envs", "max_episode_steps", "env_kwargs",
)  # fmt: skip
"""Fields of an entry that affect the results; others only affect where and how it runs."""


def subject(configs: Sequence[EnvConfig], policy: str, seed: int | None) -> dict[str, Any]:
    """Return the subject of the evaluation as it is saved."""
    return _written({"policy": policy, "seed": seed, "envs": _entries(configs, _FIELDS)})


def queue_subject(configs: Sequence[EnvConfig], policy: str) -> dict[str, Any]:
    """Return the subject of an evaluation of a queue, which any number of envs may play."""
    fields = [name for name in _FIELDS if name != "num_workers"]
    return _written({"policy": policy, "envs": _entries(configs, fields)})


def _entries(configs: Sequence[EnvConfig], fields: Sequence[str]) -> list[dict[str, Any]]:
    return [{name: getattr(config, name) for name in fields} for config in configs]


def _written(subject: dict[str, Any]) -> dict[str, Any]:
    # Values that JSON can't hold are compared by their `repr`.
    return finite(json.loads(json.dumps(subject, default=repr)))


class EvaluationFile(EpisodeFile[Episode]):
    """The episodes of an evaluation with a number for each env; see `ResultsFile`."""

    def __init__(self, path: Path, about: dict[str, Any]) -> None:
        super().__init__(path, about, label="--resume")

    def _encode(self, episode: Episode) -> dict[str, Any]:
        return finite(asdict(episode))

    def _decode(self, value: dict[str, Any]) -> Episode:
        return _episode(**value)

    def _check(self, played: list[Episode]) -> None:
        check_numbers(played)


def _episode(*, total_reward: float | None, **fields: Any) -> Episode:
    """Return an episode from its saved form; null stands for a return that is not finite."""
    return Episode(total_reward=math.nan if total_reward is None else total_reward, **fields)
