"""`ResultsFile`: the results of a queue of episodes, from which an evaluation resumes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rlightning_aio.attempts.file import EpisodeFile
from rlightning_aio.attempts.spec import EpisodeKey, EpisodeSpec
from rlightning_aio.evaluation.records import EpisodeRecord

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping

__all__ = ["ResultsFile"]


class ResultsFile(EpisodeFile[EpisodeRecord]):
    """The results of a queue of episodes as JSON lines, for this process alone.

    A line holds an episode that was played or has failed, or, with ``attempt_lost``, the cause of
    one lost attempt. Pass the file to `evaluate`::

        with ResultsFile("results.jsonl", {"policy": "act-1"}) as results:
            evaluate(group, policy, episodes, results=results)

    Args:
        path: the file, created if it is missing; a link is followed.
        subject: what is evaluated, as JSON values: the first line of the file. A file with another
            subject is refused.
        label: what messages call the file.

    Attributes:
        played: the episodes in the file.
        lost: causes of lost attempts in the file, by episode.

    Raises:
        ConfigError: the file can't be read and written, another process has it open, it belongs
            to another evaluation, or it is damaged.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        subject: Mapping[str, Any] | None = None,
        *,
        label: str = "results file",
    ) -> None:
        self.lost: dict[EpisodeKey, list[str]] = {}
        super().__init__(path, subject or {}, label=label)

    def add_lost(self, spec: EpisodeSpec, cause: str) -> None:
        """Save a lost attempt.

        Raises:
            ConfigError: it can't be written; the file is unchanged.
        """
        self.write_line({**spec.to_json(), "attempt_lost": cause})
        self.lost.setdefault(spec.key, []).append(cause)

    def _encode(self, episode: EpisodeRecord) -> dict[str, Any]:
        return episode.to_json()

    def _decode(self, value: dict[str, Any]) -> EpisodeRecord | None:
        if "attempt_lost" not in value:
            return EpisodeRecord.from_json(value)
        cause = value.pop("attempt_lost")
        self.lost.setdefault(EpisodeSpec(**value).key, []).append(str(cause))
        return None

    def _check(self, played: list[EpisodeRecord]) -> None:
        keys = set[EpisodeKey]()
        for record in played:
            if record.key in keys:
                raise ValueError(f"task {record.task!r} with seed {record.seed} is a duplicate")
            keys.add(record.key)
