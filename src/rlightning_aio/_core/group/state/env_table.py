"""`EnvTable`: names and properties of a group's envs, by slot.

A slot is an env's position in its group: local envs first, then the places of env_servers. Names
and positions never change, whoever takes a place. No step changes anything here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.batch.columns import EnvNames
from rlightning_aio.config import makers_of
from rlightning_aio.errors import EnvBusy, UnknownEnv
from rlightning_aio.registry import name_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.messages import EnvStarted
    from rlightning_aio.config import EnvConfig


class EnvTable:
    """Arrays over the envs of a group.

    Args:
        configs, env_ids: of all envs.
        num_local: the number of envs that are built with the group; the others are places.

    Attributes:
        names: of each slot.
        configs: the entry of each slot.
        num_local: as given.
        all: all slots; local: those of the local envs, the same array if there are no places.
        step_limits: steps per episode, configured or from the simulator; 0 for no limit.
        actions_beside_rows: True where actions travel in the channel and not in the row;
            reads_extras: True where extras of responses are read, which do; any_beside_rows:
            either holds for any slot.
        num_sub_envs: sub-environments of each slot; seed_offset: the number of seeds before its
            own.
        resets_itself: True where envs need no reset after an end; any_resets_itself: for any slot.
    """

    def __init__(
        self,
        configs: Sequence[EnvConfig],
        env_ids: Sequence[str],
        num_local: int | None = None,
    ) -> None:
        self.configs = list(configs)
        size = len(self.configs)
        self.num_local = size if num_local is None else num_local
        self._slot_of = {env_id: slot for slot, env_id in enumerate(env_ids)}
        entry_names = list(dict.fromkeys(config.name for config in self.configs))
        number = {name: k for k, name in enumerate(entry_names)}
        self.names = EnvNames(
            list(env_ids),
            np.array([number[config.name] for config in self.configs], np.intp),
            entry_names,
            index_offset=np.zeros(size, np.int64),
        )
        self.all = np.arange(size)
        self.local = self.all if self.num_local == size else np.arange(self.num_local)
        self.step_limits = np.array(
            [config.max_episode_steps or 0 for config in self.configs], np.int64
        )
        self.actions_beside_rows = np.zeros(size, np.bool_)
        self.reads_extras = np.zeros(size, np.bool_)
        self.any_beside_rows = False
        self.num_sub_envs = np.array([config.num_envs for config in self.configs], np.int64)
        self.seed_offset = np.zeros(size, np.int64)
        self.resets_itself = np.zeros(size, np.bool_)
        self.any_resets_itself = False

    def __len__(self) -> int:
        return len(self.configs)

    @property
    def env_ids(self) -> Sequence[str]:
        """The env id of each slot."""
        return self.names.env_ids

    # -- properties -------------------------------------------------------------------

    def note_started(self, started: Sequence[EnvStarted]) -> None:
        """Record the properties of the local envs, in the order of their slots."""
        for slot, env in enumerate(started):
            self._note(slot, env)
            self.num_sub_envs[slot] = env.meta.num_envs
        self.seed_offset[:] = np.cumsum(self.num_sub_envs) - self.num_sub_envs
        self.names.index_offset[:] = self.seed_offset
        self._note_any()

    def note_taken(self, slot: int, env: EnvStarted) -> None:
        """Record the properties of the env of a client that has taken a place."""
        self._note(slot, env)
        self._note_any()

    def _note(self, slot: int, env: EnvStarted) -> None:
        self.actions_beside_rows[slot] = env.actions_beside_row
        self.reads_extras[slot] = env.reads_extras
        self.resets_itself[slot] = env.meta.autoreset != "disabled"
        most = self.configs[slot].max_episode_steps or env.meta.max_episode_steps
        self.step_limits[slot] = most or 0

    def _note_any(self) -> None:
        self.any_beside_rows = bool(self.actions_beside_rows.any() or self.reads_extras.any())
        self.any_resets_itself = bool(self.resets_itself.any())

    # -- names ------------------------------------------------------------------------

    def find(self, env_ids: Sequence[str]) -> NDArray[np.intp]:
        """The slots of `env_ids`, in that order.

        Raises:
            TypeError: they are one str.
            UnknownEnv: no env of this group has one of the ids.
        """
        if isinstance(env_ids, str):
            raise TypeError(f"env_ids is a sequence of ids: give [{env_ids!r}]")
        if len(env_ids) == len(self.all) and list(env_ids) == self.env_ids:
            return self.all
        slot_of = self._slot_of
        try:
            return np.array([slot_of[env_id] for env_id in env_ids], np.intp)
        except KeyError as missing:
            raise UnknownEnv(self._unknown(missing.args[0])) from None

    def chosen(self, env_ids: Sequence[str] | None) -> NDArray[np.intp]:
        """The slots of `env_ids`, or of all envs; `EnvBusy` if an id appears twice."""
        slots = self.all if env_ids is None else self.find(env_ids)
        if env_ids is not None and slots is not self.all and len(set(env_ids)) < len(slots):
            double = next(id_ for k, id_ in enumerate(env_ids) if id_ in env_ids[:k])
            raise EnvBusy(f"{double!r} appears twice in one call; nothing was sent")
        return slots

    def find_one(self, env_id: str) -> int:
        """The slot of `env_id`; raises `UnknownEnv`."""
        try:
            return self._slot_of[env_id]
        except KeyError:
            raise UnknownEnv(self._unknown(env_id)) from None

    def _unknown(self, env_id: Any) -> str:
        ids = list(self._slot_of)
        known = ", ".join(ids[:8]) + (", …" if len(ids) > 8 else "")
        return f"no env of this group is called {env_id!r}; its envs are {known}"

    def check_local(self, slots: NDArray[np.intp], what: str) -> None:
        """Raise `NotImplementedError` if any of `slots` belongs to a client."""
        if (remote := slots[slots >= self.num_local]).size:
            raise NotImplementedError(
                f"can't {what} {self.describe(int(remote[0]))}: clients answer resets and "
                "steps only; nothing was sent"
            )

    def describe(self, slot: int) -> str:
        """The name of an env in messages, with its entry, backend and task."""
        config = self.configs[slot]
        env_id = self.env_ids[slot]
        task = repr(config.task_name)
        if makers := makers_of(config):
            first = next(k for k, other in enumerate(self.configs) if other is config)
            task = name_of(makers[slot - first])
        return f"env {env_id!r} (entry {config.name!r}, backend {config.backend}, task {task})"
