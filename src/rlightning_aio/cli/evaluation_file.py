"""The file that ``eval --resume`` keeps: what is evaluated, and each episode as it ends.

Rule: a line of JSON is written whole before the next one, so whatever ends the command, what the
file holds was played to its end; a last line without its end was not.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final, Self

from rlightning_aio.errors import ConfigError
from rlightning_aio.evaluation import Episode

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rlightning_aio.config import EnvConfig

__all__ = ["EvaluationFile", "subject"]

_TOLD: Final = (
    "name", "backend", "task", "num_workers", "num_envs", "max_episode_steps", "env_kwargs",
)  # fmt: skip
"""Fields of an entry that say what is evaluated; others say where and how."""


def subject(configs: Sequence[EnvConfig], policy: str, seed: int | None) -> dict[str, Any]:
    """What is evaluated, as it is written down."""
    entries = [{name: getattr(config, name) for name in _TOLD} for config in configs]
    # What JSON has no word for is compared as it prints.
    return json.loads(json.dumps({"policy": policy, "seed": seed, "envs": entries}, default=repr))


class EvaluationFile:
    """Opens the file, or makes it.

    Args:
        path: of the file.
        about: what is evaluated, see `subject`.

    Attributes:
        played: the episodes that it holds.

    Raises:
        ConfigError: it can't be read and written, or is of another evaluation.
    """

    def __init__(self, path: Path, about: dict[str, Any]) -> None:
        self._path, self.played = path, list[Episode]()
        try:
            self._file = path.open("a+", encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"--resume {path}: can't be written: {error.strerror}") from None
        try:
            self._read(about)
        except BaseException:
            self._file.close()
            raise

    def _read(self, about: dict[str, Any]) -> None:
        self._file.seek(0)
        foreign = ConfigError(f"--resume {self._path}: is not a file that eval has written")
        try:
            text = self._file.read()
            whole = text[: text.rfind("\n") + 1]
            values: list[Any] = [json.loads(line) for line in whole.splitlines()]
            before: dict[str, Any] = {**values[0]} if values else {}
            self.played = [Episode(**value) for value in values[1:]]
        except (ValueError, TypeError):
            raise foreign from None
        if not text:
            self._write(about)
        elif before.keys() != about.keys():
            raise foreign
        elif before != about:
            told = "; ".join(
                f"its {key} is {before[key]}, not {about[key]}"
                for key in about
                if before[key] != about[key]
            )
            raise ConfigError(
                f"--resume {self._path}: is of another evaluation ({told}); name another file, or "
                "use the same settings as before"
            )
        else:
            self._file.truncate(len(whole.encode()))

    def add(self, episode: Episode) -> None:
        """Keep an episode that has ended."""
        self._write(asdict(episode))

    def _write(self, value: dict[str, Any]) -> None:
        self._file.write(json.dumps(value) + "\n")
        self._file.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.close()
