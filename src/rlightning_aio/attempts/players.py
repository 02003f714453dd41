"""`Players`: which envs of a group can play which episodes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from rlightning_aio._core.group.api.facade import is_lost_hardware, is_resettable, lost_hardware
from rlightning_aio.attempts.rules import is_from_env
from rlightning_aio.attempts.spec import EpisodeSpec
from rlightning_aio.errors import RLightningError

if TYPE_CHECKING:
    from rlightning_aio.outcomes import Outcome


class _Player(NamedTuple):
    entry: str
    task: str
    switches_task: bool


class Players:
    """The envs of an initialised group, and the places that have a client.

    Attributes:
        entry_of: the name of the config entry of each env.
        worker_of: the ids of all envs in the worker of each env.
        left_alone: what moves something real and was lost or has raised: only its user resets it.
        present: envs that are there, and not left alone.
    """

    def __init__(self, group: Any) -> None:
        self._group = group
        self.entry_of: dict[str, str] = {}
        self.worker_of: dict[str, list[str]] = {}
        for worker in group.get_workers():
            for env_id in worker["env_ids"]:
                self.entry_of[env_id], self.worker_of[env_id] = worker["entry"], worker["env_ids"]
        self._players: dict[str, _Player] = {}
        self._kinds: dict[_Player, None] = {}  # All that differ, the last of the envs last.
        for meta in group.metas:
            player = _Player(self.entry_of[meta.env_id], meta.task, meta.switches_task)
            self._players[meta.env_id] = player
            self._kinds.pop(player, None)
            self._kinds[player] = None
        self.left_alone: set[str] = set()
        self.present: set[str] = set()
        self.refresh()

    def refresh(self) -> None:
        """Look which envs are there now."""
        present: set[str] = set()
        for worker in self._group.get_workers():
            if worker["state"] != "empty":
                present.update(worker["env_ids"])
        self.left_alone.update(lost_hardware(self._group))
        self.present = present - self.left_alone

    def note(self, outcome: Outcome) -> None:
        """Leave what moves something real alone after a failure of it."""
        if is_from_env(outcome) and not is_resettable(self._group, outcome.env_id):
            self._leave_alone(outcome.env_id)

    def has_left(self, env_id: str) -> bool:
        """Leave what moves something real alone if it was lost while it was idle."""
        is_lost = is_lost_hardware(self._group, env_id)
        if is_lost:
            self._leave_alone(env_id)
        return is_lost

    def _leave_alone(self, env_id: str) -> None:
        self.left_alone.add(env_id)
        self.present.discard(env_id)

    def assigned(self, spec: EpisodeSpec) -> EpisodeSpec:
        """Return an episode with the entry that plays it.

        Raises:
            TypeError: it is no `EpisodeSpec`.
            ValueError: no entry can play it, or more than one can, or its env is not there.
        """
        if not isinstance(cast("Any", spec), EpisodeSpec):
            raise TypeError(f"episodes should be EpisodeSpec, not {spec!r}")
        entries = dict.fromkeys(player.entry for player in self._kinds)
        if spec.entry not in ("", *entries):
            raise ValueError(f"there is no entry {spec.entry!r}; entries are {', '.join(entries)}")
        if spec.env_id not in ("", *self._players):
            raise ValueError(f"there is no env {spec.env_id!r} to play {spec}")
        kinds = self._kinds if not spec.env_id else [self._players[spec.env_id]]
        able = {
            player.entry: player
            for player in kinds
            if spec.entry in ("", player.entry) and _can_play(player, spec.task)
        }
        exact = {entry: player for entry, player in able.items() if player.task == spec.task}
        found = exact if len(exact) == 1 else able
        if not found:
            raise ValueError(
                f"no entry{spec.entry and f' {spec.entry!r}'} of this group can play {spec}; its "
                "env has another task, and doesn't switch tasks"
            )
        if len(found) > 1:
            raise ValueError(f"entries {', '.join(found)} can play {spec}; name one as its entry")
        ((entry, player),) = found.items()
        if player.switches_task and "task" in (spec.options or {}):
            raise ValueError(f"the options of an episode must not name a task: {spec}")
        return replace(spec, entry=entry, task=spec.task or player.task)

    def options(self, env_id: str, spec: EpisodeSpec) -> dict[str, Any] | None:
        """Return the options of the reset that begins an episode on an env."""
        if self._players[env_id].switches_task:
            return {"task": spec.task, **(spec.options or {})}
        return None if spec.options is None else {**spec.options}

    def entries_left(self) -> set[str]:
        """The entries with an env that is not left alone."""
        alone = self.left_alone
        return {entry for env_id, entry in self.entry_of.items() if env_id not in alone}

    def refusal(self, env_id: str) -> RLightningError:
        """The error for attempts that only an env which is left alone could play."""
        return RLightningError(
            f"env {env_id!r} was lost or has raised an error, and may move something real, so it "
            f"is reset only if you ask for it: group.reset(env_ids=[{env_id!r}]), and then play on"
        )


def _can_play(player: _Player, task: str) -> bool:
    return not task or player.switches_task or task == player.task
