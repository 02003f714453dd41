"""`EnvTable`: who the envs of a group are, by slot, and what they make of requests.

A slot is an env's position in its group: local envs first, then so many places for each
env_server as it may have clients. Nothing here changes with a step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio.batch.names import EnvNames
from rlightning_aio.errors import UnknownEnv

if TYPE_CHECKING:
    from collections.abc import Sequence

    import gymnasium as gym
    from numpy.typing import NDArray

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.hosts.messages import EnvStarted
    from rlightning_aio.types import ClientTraits, EnvMeta

__all__ = ["EnvTable"]


class EnvTable:
    """Arrays over the envs of a group.

    Args:
        configs, env_ids: of the local envs.
        servers: id, config and number of slots of each env_server.

    Attributes:
        names: of each slot; replaced when a client takes one.
        configs: of each slot.
        local_ids, server_ids: of the local envs, and of the env_servers.
        all: slots of the local envs.
        step_limits: of an episode, configured or the simulator's own; 0 for none.
        out_of_band_actions: actions may not fit the row; reads_extras: responses' extras are
            read there; any_out_of_band: either is true of any env.
        num_sub_envs: of each; seed_offset: how many seeds come before its own; num_seeds:
            those of all local envs.
        resets_itself: it needs no reset after an end; any_resets_itself: true of any env.
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
        for server_id, config, count in servers:
            self.configs += [config] * count
            shared_ids += [server_id] * count
        size = len(self.configs)
        self._slot_of = {env_id: slot for slot, env_id in enumerate(env_ids)}
        entry_names = list(dict.fromkeys(config.name for config in self.configs))
        number = {name: k for k, name in enumerate(entry_names)}
        self._min_results = {config.name: config.min_results or 0 for config in self.configs}
        self.names = EnvNames(
            [*env_ids, *[""] * (size - len(env_ids))],
            shared_ids,
            np.array([number[config.name] for config in self.configs], np.intp),
            entry_names,
            index_offset=np.zeros(size, np.int64),
            turns=np.zeros(size, np.bool_),
        )
        self.all = np.arange(len(env_ids))
        self.step_limits = np.array(
            [config.max_episode_steps or 0 for config in self.configs], np.int64
        )
        self.out_of_band_actions = np.zeros(size, np.bool_)
        self.reads_extras = np.zeros(size, np.bool_)
        self.any_out_of_band = False
        self.num_sub_envs = np.ones(size, np.int64)
        self.seed_offset = np.zeros(size, np.int64)
        self.num_seeds = 0
        self.resets_itself = np.zeros(size, np.bool_)
        self.any_resets_itself = False
        self.observation_spaces: list[gym.Space[Any] | None] = []

    def __len__(self) -> int:
        return len(self.configs)

    @property
    def env_ids(self) -> Sequence[str]:
        """Of each slot; empty for one that no client has taken."""
        return self.names.env_ids

    # -- what envs tell of themselves -------------------------------------------------

    def note_started(self, started: Sequence[EnvStarted]) -> None:
        """Take note of what the local envs are like, in the order of their slots."""
        self.observation_spaces = [env.meta.observation_space for env in started]
        for slot, env in enumerate(started):
            fits_row = env.layout.action_leaves is not None
            self.out_of_band_actions[slot] = env.transforms_actions or not fits_row
            self.reads_extras[slot] = env.reads_extras
            self._note_meta(slot, env.meta)
            # Seeds are the sub-environments', of which a result may hold some only.
            in_all = self.configs[slot].num_envs
            self.names.turns[slot] = in_all > env.meta.num_envs
            self.num_sub_envs[slot] = max(env.meta.num_envs, in_all)
        local = self.num_sub_envs[self.all]
        self.num_seeds = int(local.sum())
        self.seed_offset[self.all] = np.cumsum(local) - local
        self.names.index_offset[:] = self.seed_offset
        self._note_any()

    def note_joined(
        self, slot: int, first_slot: int, meta: EnvMeta, traits: ClientTraits, *, has_row: bool
    ) -> None:
        """Take note of a client that has taken a slot, perhaps from another.

        Args:
            slot: the client's.
            first_slot: that of its env_server.
            meta: what it told of its env.
            traits: what it makes of requests.
            has_row: its actions have a place in its row.
        """
        self._slot_of.pop(self.env_ids[slot], None)
        self._slot_of[meta.env_id] = slot
        self.out_of_band_actions[slot] = traits.free_actions or not has_row
        self.reads_extras[slot] = traits.reads_extras
        self._note_meta(slot, meta)
        self.num_sub_envs[slot] = meta.num_envs
        # Clients of one env_server are of one kind.
        behind = (first_slot - len(self.all)) + (slot - first_slot) * meta.num_envs
        self.names = self.names.renamed(slot, meta.env_id, self.num_seeds + behind)
        self._note_any()

    def _note_meta(self, slot: int, meta: EnvMeta) -> None:
        self.resets_itself[slot] = meta.autoreset != "disabled"
        self.step_limits[slot] = self.configs[slot].max_episode_steps or meta.max_episode_steps or 0

    def _note_any(self) -> None:
        self.any_out_of_band = bool(self.out_of_band_actions.any() or self.reads_extras.any())
        self.any_resets_itself = bool(self.resets_itself.any())

    # -- names ------------------------------------------------------------------------

    def find(self, env_ids: Sequence[str]) -> NDArray[np.intp]:
        """Slots of `env_ids`, in their order.

        Raises:
            UnknownEnv: an id is no env's of this group.
        """
        if len(env_ids) == len(self.local_ids) and list(env_ids) == self.local_ids:
            return self.all
        slot_of = self._slot_of
        try:
            return np.array([slot_of[env_id] for env_id in env_ids], np.intp)
        except KeyError as missing:
            raise UnknownEnv(self._unknown(missing.args[0])) from None

    def find_one(self, env_id: str) -> int:
        """Slot of `env_id`; raises `UnknownEnv`."""
        try:
            return self._slot_of[env_id]
        except KeyError:
            raise UnknownEnv(self._unknown(env_id)) from None

    def _unknown(self, env_id: Any) -> str:
        ids = list(self._slot_of)
        known = ", ".join(ids[:8]) + (", …" if len(ids) > 8 else "")
        return f"no env of this group is called {env_id!r}; its envs are {known}"

    def of_entries(self, names: Sequence[str]) -> NDArray[np.bool_]:
        """Which slots belong to the config entries called `names`.

        Raises:
            UnknownEnv: there is no such entry.
        """
        entry_names = self.names.entry_names
        for name in names:
            if name not in entry_names:
                known = ", ".join(entry_names)
                raise UnknownEnv(f"no entry of this group is called {name!r}; they are {known}")
        return np.isin(self.names.entries, [entry_names.index(name) for name in names])

    def usual_min_results(self, names: Sequence[str] | None) -> int:
        """Results for which a collect of some entries waits, or of all, if nobody says another."""
        wanted = self._min_results
        known = wanted.values() if names is None else (wanted.get(name, 0) for name in names)
        return max(1, sum(known))

    def describe(self, slot: int) -> str:
        """How an error message names the env."""
        config = self.configs[slot]
        env_id = self.env_ids[slot] or self.names.shared_ids[slot]
        makers: Any = config.make_env
        if isinstance(makers, tuple):
            first = next(k for k, other in enumerate(self.configs) if other is config)
            makers = cast("tuple[Any, ...]", makers)[slot - first]
        made = f"make_env {_name(makers)}" if makers else f"task {config.task!r}"
        return f"env {env_id!r} (entry {config.name!r}, backend {config.backend}, {made})"


def _name(function: Any) -> str:
    """What a callable is called where it was written."""
    return getattr(function, "__qualname__", type(function).__name__)
