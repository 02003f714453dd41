"""`EnvTable`: positions of envs in the group."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from rlightning_aio._core.group.state.env_table import EnvTable
from rlightning_aio.config import EnvConfig
from rlightning_aio.types import ClientTraits, EnvMeta

CLIENTS = [("a", 0), ("a", 1), ("b", 0), ("c", 1)]


@pytest.mark.parametrize("order", list(permutations(CLIENTS)))
def test_no_two_sub_environments_of_env_servers_have_the_same_index(
    order: list[tuple[str, int]],
) -> None:
    """In whatever order clients join, also again; each keeps its index."""
    num_sub_envs, num_slots = {"a": 64, "b": 1, "c": 3}, 8
    servers = [
        (f"{name}-0", EnvConfig(name=name, backend="env_server"), num_slots) for name in "abc"
    ]
    envs = EnvTable([], [], servers)
    envs.note_started([])
    found: dict[tuple[str, int], int] = {}
    for name, client in [*order, *order]:
        first_slot = "abc".index(name) * num_slots
        count = num_sub_envs[name]
        meta = EnvMeta(
            env_id=f"{name}-0/{client}", observation_space=None, action_space=None, num_envs=count
        )
        envs.note_joined(
            first_slot + client, first_slot, meta, ClientTraits(False, False), has_row=True
        )
        index = envs.names.index_offset.item(first_slot + client)
        assert found.setdefault((name, client), index) == index
    used = [np.arange(num_sub_envs[name]) + first for (name, _), first in found.items()]
    assert len(set(np.concatenate(used).tolist())) == sum(map(len, used))
