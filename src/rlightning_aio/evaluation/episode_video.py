"""`EpisodeVideo`: films of chosen episodes of a queue, or only of those that don't succeed.

Rule: the env's worker films, as for `record_video`. An episode is filmed into a folder of its own,
and its film gets its name when the outcome is known.
"""

from __future__ import annotations

import re
import shutil
import zlib
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from rlightning_aio._core.hosts.messages import RECORD_VIDEO, FilmOrder
from rlightning_aio.attempts.spec import written
from rlightning_aio.files import check_folder, file_name, finish_file

if TYPE_CHECKING:
    import os
    from collections.abc import Callable

    from rlightning_aio.attempts.records import Attempt
    from rlightning_aio.attempts.spec import EpisodeSpec
    from rlightning_aio.collecting.procedure import Procedure

__all__ = ["EpisodeVideo", "Filming", "Wanted"]

Wanted: TypeAlias = bool | Literal["failed"]
"""Whether the film of an episode is wanted, or only if the episode fails."""


@dataclass(frozen=True, slots=True)
class EpisodeVideo:
    """The episodes to film.

    Attributes:
        folder, wants: `video` and `video_if` of `evaluate`.
    """

    folder: str | os.PathLike[str]
    wants: Callable[[EpisodeSpec], Wanted] | None = None


@dataclass(slots=True)
class Filming:
    """The films in progress.

    Args:
        group: whose envs are filmed.
        video: the episodes to film.

    Raises:
        OSError: nothing can be written into the folder.
    """

    group: Any
    video: EpisodeVideo
    _filmed: dict[str, Wanted] = field(default_factory=dict[str, "Wanted"])
    """Envs that are filming an episode, and whether its film is wanted."""

    def __post_init__(self) -> None:
        check_folder(self.video.folder)

    def begin(self, env_id: str, spec: EpisodeSpec) -> Procedure[None]:
        """Film the next episode of an idle env, if it is wanted."""
        wanted = self.video.wants is None or self.video.wants(spec)
        if wanted:
            folder = self._folder(env_id)
            shutil.rmtree(folder, ignore_errors=True)
            order = FilmOrder(str(folder), episodes=(0,))
            yield partial(self.group[env_id].call, RECORD_VIDEO, order)
            self._filmed[env_id] = wanted

    def end(self, env_id: str, attempt: Attempt) -> Procedure[None]:
        """Stop filming an idle env, and keep or delete the film of the episode."""
        if env_id in self._filmed:
            yield partial(self.group[env_id].call, RECORD_VIDEO, None)
            wanted = self._filmed.pop(env_id)
            folder = self._folder(env_id)
            if wanted != "failed" or attempt.success is False:
                # A step limit of the group ends an episode, but not its film.
                for film in folder.glob("*-episode-0*.mp4"):
                    finish_file(film, Path(self.video.folder, _name(attempt)))
            shutil.rmtree(folder, ignore_errors=True)

    def drop(self, env_id: str) -> None:
        """Delete what was filmed of an episode that was lost."""
        if env_id in self._filmed:
            del self._filmed[env_id]
            shutil.rmtree(self._folder(env_id), ignore_errors=True)

    def _folder(self, env_id: str) -> Path:
        return Path(self.video.folder, f"{file_name(env_id)}.partial").absolute()


def _name(attempt: Attempt) -> str:
    spec = attempt.spec
    options = written(spec.options)
    number = f"-{zlib.crc32(options.encode()):08x}" if options else ""
    if spec.env_id:
        number += f"-{spec.env_id}-episode-{attempt.index}"
    return re.sub(r"[^\w.-]+", "_", f"{spec.entry}-{spec.task}-seed-{spec.seed}{number}") + ".mp4"
