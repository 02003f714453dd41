"""How the envs of a group are spread over hosts, before anything is started."""

from __future__ import annotations

import sys
from typing import Any

import pytest

from rlightning_aio import sync
from rlightning_aio.errors import ConfigError
from rlightning_aio.group import build

POLE = {"backend": "gymnasium", "task": "CartPole-v1"}
OTHER = {"backend": "probe", "task": "x"}


@pytest.mark.parametrize(
    ("num_cores", "entries", "spread"),
    [
        (2, [POLE | {"num_workers": 5}], [[2, 3]]),
        (4, [POLE | {"num_workers": 2}], [[1, 1]]),
        (2, [POLE | {"num_workers": 4}] * 3, [[4], [4], [4]]),
        (6, [POLE | {"num_workers": 16}, POLE | {"num_workers": 8}], [[4] * 4, [4] * 2]),
        (8, [POLE | {"num_workers": 100}, POLE], [[14, 14, 14, 15, 14, 14, 15], [1]]),
        # What says itself where its envs live, or keeps no core busy, takes none of the cores.
        (
            2,
            [
                POLE | {"num_workers": 4},
                POLE | {"num_workers": 4, "envs_per_process": 1},
                POLE | {"num_workers": 4, "placement": "inline"},
                OTHER | {"num_workers": 2},
            ],
            [[2, 2], [1, 1, 1, 1], [4], [1, 1]],
        ),
    ],
)
def test_entries_share_the_cores(
    monkeypatch: pytest.MonkeyPatch,
    num_cores: int,
    entries: list[dict[str, Any]],
    spread: list[list[int]],
) -> None:
    """By their numbers of envs, and each has a worker at least."""
    monkeypatch.setattr(build, "num_cores", lambda: num_cores)
    named = [entry | {"name": f"e{k}"} for k, entry in enumerate(entries)]
    group = sync.build_env_group(named)
    hosts = [host.num_envs for host in group._core.supervisor.hosts]
    assert hosts == [count for counts in spread for count in counts]
    group.close()


def test_a_placement_whose_package_is_missing_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Before anything is started."""
    monkeypatch.delitem(sys.modules, "rlightning_aio.hosts.ray", raising=False)
    monkeypatch.delitem(sys.modules, "rlightning_aio.hosts.ray_host", raising=False)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"entry 'e'.*pip install 'rlightning-aio\[ray\]'"):
        sync.build_env_group(POLE | {"name": "e", "placement": "ray"})
