"""`EnvTable`: names and properties of a group's envs, by slot.

A slot is an env's position in its group: local envs first, then one slot for each env that may join
a host while the group runs (a member). No step changes anything here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.batch.names import EnvNames
from rlightning_aio.config import makers_of
from rlightning_aio.errors import UnknownEnv
from rlightning_aio.registry import name_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    import gymnasium as gym
    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.messages import EnvStarted
    from rlightning_aio.config import EnvConfig
    from rlightning_aio.types import ClientTraits, EnvMeta

__all__ = ["EnvTable"]


class EnvTable:
    """Arrays over the envs of a group.

    Args:
        configs, env_ids: of the local envs.
        servers: id, config and number of slots of each host that envs join.

    Attributes:
        names: of each slot; replaced when a member takes a slot.
        configs: the entry of each slot.
        local_ids, server_ids: ids of the local envs, and of the hosts that envs join.
        all: slots of the local envs.
        step_limits: steps per episode, configured or from the simulator; 0 for no limit.
        actions_beside_rows: True where actions travel in the channel and not in the row;
            reads_extras: True where extras of responses are read, which do; any_beside_rows:
            either holds for any slot.
        num_sub_envs: sub-environments of each slot; seed_offset: the number of seeds before its
            own; num_seeds: the number for all local envs.
        resets_itself: True where envs need no reset after an end; any_resets_itself: for any slot.
        observation_spaces: of the local envs.
    """

    def __init__(
        self,
        configs: Sequence[EnvConfig],
        env_ids: Sequence[str],
        servers: Sequence[tuple[str, EnvConfig, int]] = (),
    ) -> None:
        self.local_ids = list(env_ids)
        self.server_ids = [server_id for server_id, _, _ in servers]
        self.configs = list(configs)
        shared_ids = list(env_ids)
        # Of each host that envs join, by its first slot: how many may, and the index of the first.
        self._num_members: dict[int, int] = {}
        self._first_index: dict[int, int] = {}
        for server_id, config, count in servers:
            self._num_members[len(self.configs)] = count
            self.configs += [config] * count
            shared_ids += [server_id] * count
        size = len(self.configs)
        self._slot_of = {env_id: slot for slot, env_id in enumerate(env_ids)}
        entry_names = list(dict.fromkeys(config.name for config in self.configs))
        number = {name: k for k, name in enumerate(entry_names)}
        self.names = EnvNames(
            [*env_ids, *[""] * (size - len(env_ids))],
            shared_ids,
            np.array([number[config.name] for config in self.configs], np.intp),
            entry_names,
            index_offset=np.zeros(size, np.int64),
        )
        self.all = np.arange(len(env_ids))
        self.step_limits = np.array(
            [config.max_episode_steps or 0 for config in self.configs], np.int64
        )
        self.actions_beside_rows = np.zeros(size, np.bool_)
        self.reads_extras = np.zeros(size, np.bool_)
        self.any_beside_rows = False
        self.num_sub_envs = np.ones(size, np.int64)
        self.seed_offset = np.zeros(size, np.int64)
        self.num_seeds = self._next_index = 0
        self.resets_itself = np.zeros(size, np.bool_)
        self.any_resets_itself = False
        self.observation_spaces: list[gym.Space[Any] | None] = []

    def __len__(self) -> int:
        return len(self.configs)

    @property
    def env_ids(self) -> Sequence[str]:
        """The env id of each slot; empty for a free slot of a member."""
        return self.names.env_ids

    # -- properties -------------------------------------------------------------------

    def note_started(self, started: Sequence[EnvStarted]) -> None:
        """Record the properties of the local envs, in the order of their slots."""
        self.observation_spaces = [env.meta.observation_space for env in started]
        for slot, env in enumerate(started):
            self.actions_beside_rows[slot] = env.actions_beside_row
            self.reads_extras[slot] = env.reads_extras
            self._note_meta(slot, env.meta)
            self.num_sub_envs[slot] = env.meta.num_envs
        local = self.num_sub_envs[self.all]
        self.num_seeds = self._next_index = int(local.sum())
        self.seed_offset[self.all] = np.cumsum(local) - local
        self.names.index_offset[:] = self.seed_offset
        self._note_any()

    def note_joined(
        self, slot: int, first_slot: int, meta: EnvMeta, traits: ClientTraits, *, has_row: bool
    ) -> None:
        """Record the properties of a member that has taken a slot, free or of another one.

        Args:
            slot: of the member.
            first_slot: of its host.
            meta: reported by the member.
            traits: how the member treats requests.
            has_row: its actions fit its row.
        """
        self._slot_of.pop(self.env_ids[slot], None)
        self._slot_of[meta.env_id] = slot
        self.actions_beside_rows[slot] = traits.free_actions or not has_row
        self.reads_extras[slot] = traits.reads_extras
        self._note_meta(slot, meta)
        self.num_sub_envs[slot] = meta.num_envs
        # All members of a host have the same number of sub-environments; the first one shows it.
        if first_slot not in self._first_index:
            self._first_index[first_slot] = self._next_index
            self._next_index += self._num_members[first_slot] * meta.num_envs
        index = self._first_index[first_slot] + (slot - first_slot) * meta.num_envs
        self.names = self.names.renamed(slot, meta.env_id, index)
        self._note_any()

    def _note_meta(self, slot: int, meta: EnvMeta) -> None:
        self.resets_itself[slot] = meta.autoreset != "disabled"
        self.step_limits[slot] = self.configs[slot].max_episode_steps or meta.max_episode_steps or 0

    def _note_any(self) -> None:
        self.any_beside_rows = bool(self.actions_beside_rows.any() or self.reads_extras.any())
        self.any_resets_itself = bool(self.resets_itself.any())

    # -- names ------------------------------------------------------------------------

    def find(self, env_ids: Sequence[str]) -> NDArray[np.intp]:
        """The slots of `env_ids`, in that order.

        Raises:
            UnknownEnv: no env of this group has one of the ids.
        """
        if len(env_ids) == len(self.local_ids) and list(env_ids) == self.local_ids:
            return self.all
        slot_of = self._slot_of
        try:
            return np.array([slot_of[env_id] for env_id in env_ids], np.intp)
        except KeyError as missing:
            raise UnknownEnv(self._unknown(missing.args[0])) from None

    def find_one(self, env_id: str) -> int:
        """The slot of `env_id`; raises `UnknownEnv`."""
        try:
            return self._slot_of[env_id]
        except KeyError:
            raise UnknownEnv(self._unknown(env_id)) from None

    def position(self, slot: int) -> int:
        """The position of an env among the ids of a group, where a member has that of its host."""
        num_local = len(self.local_ids)
        if slot < num_local:
            return slot
        return num_local + self.server_ids.index(self.names.shared_ids[slot])

    def _unknown(self, env_id: Any) -> str:
        ids = list(self._slot_of)
        known = ", ".join(ids[:8]) + (", …" if len(ids) > 8 else "")
        return f"no env of this group is called {env_id!r}; its envs are {known}"

    def describe(self, slot: int) -> str:
        """The name of an env in messages, with its entry, backend and task."""
        config = self.configs[slot]
        env_id = self.env_ids[slot] or self.names.shared_ids[slot]
        task = repr(config.task_name)
        if makers := makers_of(config):
            first = next(k for k, other in enumerate(self.configs) if other is config)
            task = name_of(makers[slot - first])
        return f"env {env_id!r} (entry {config.name!r}, backend {config.backend}, task {task})"
