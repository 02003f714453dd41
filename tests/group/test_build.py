"""How the envs of a group are spread over hosts before anything starts."""

from __future__ import annotations

import sys
from typing import Any

import gymnasium as gym
import pytest

from rlightning_aio import sync
from rlightning_aio._core.group.setup import build
from rlightning_aio.errors import ConfigError

POLE = {"backend": "gymnasium", "task": "CartPole-v1"}
OTHER = {"backend": "probe", "task": "x"}


class Coroutines:
    """An awaitable env's class."""

    async def step(self, action: Any) -> Any:
        """Wait."""


gym.register("test_build/Own-v0", "json:JSONDecoder")
OWN = {"task": lambda: None}
FOREIGN = {"task": "test_build/Own-v0"}
LISTED = {"backend": "mujoco", "task": "test_build/Own-v0"}
MADE = {"task": lambda: gym.make("CartPole-v1")}
COROUTINES = {"task": Coroutines}


@pytest.mark.parametrize(
    ("num_cores", "entries", "spread"),
    [
        (2, [POLE | {"num_workers": 5}], [[2, 3]]),
        (4, [POLE | {"num_workers": 2}], [[1, 1]]),
        (2, [POLE | {"num_workers": 4}] * 3, [[4], [4], [4]]),
        (6, [POLE | {"num_workers": 16}, POLE | {"num_workers": 8}], [[4] * 4, [4] * 2]),
        (8, [POLE | {"num_workers": 100}, POLE], [[14, 14, 14, 15, 14, 14, 15], [1]]),
        # Entries that fix where their envs live, or keep no core busy, get no share of the cores.
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
        # Nobody knows whether own envs may share a process, so they have a worker each.
        (2, [OWN | {"num_workers": 5}, POLE | {"num_workers": 4}], [[1] * 5, [2, 2]]),
        (1, [OWN | {"num_workers": 20}], [[1] * 20]),
        (4, [FOREIGN | {"num_workers": 3}, LISTED | {"num_workers": 8}], [[1] * 3, [2] * 4]),
        (2, [MADE | {"num_workers": 4}], [[1] * 4]),
        (2, [COROUTINES | {"num_workers": 40}], [[20, 20]]),
    ],
)
def test_entries_share_the_cores(
    monkeypatch: pytest.MonkeyPatch,
    num_cores: int,
    entries: list[dict[str, Any]],
    spread: list[list[int]],
) -> None:
    """In proportion to their numbers of envs, with at least one worker each."""
    monkeypatch.setattr(build, "num_cores", lambda: num_cores)
    named = [entry | {"name": f"e{k}"} for k, entry in enumerate(entries)]
    group = sync.build_env_group(named)
    hosts = [len(worker["env_ids"]) for worker in group.get_workers()]
    assert hosts == [count for counts in spread for count in counts]
    group.close()


def test_a_placement_whose_package_is_missing_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The error comes before anything starts."""
    monkeypatch.delitem(sys.modules, "rlightning_aio._core.hosts.ray.host", raising=False)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"entry 'e'.*pip install 'rlightning-aio\[ray\]'"):
        sync.build_env_group(POLE | {"name": "e", "placement": "ray"})


def test_the_repr_of_a_group_lists_its_envs_and_their_placement() -> None:
    """Before the start and after the close, too."""
    entries = [
        POLE | {"name": "pole", "num_workers": 4, "envs_per_process": 2},
        POLE | {"name": "many", "num_envs": 16, "placement": "inline"},
        POLE | {"name": "one", "envs_per_process": 1},
        {"name": "arms", "backend": "env_server", "env_kwargs": {"port": 0, "insecure": True}},
    ]
    group = sync.build_env_group(entries)
    said = repr(group)
    assert repr(group[group.env_ids[0]]) == f"EnvHandle({group.env_ids[0]!r})"
    assert said == (
        "EnvGroup(pole: 4 envs, placement process, 2 worker processes; "
        "many: 1 env of 16 sub-environments, placement inline, 0 worker processes; "
        "one: 1 env, placement process, 1 worker process; "
        "arms: 1 place for clients)"
    )
    group.close()
    assert repr(group) == said


def test_init_logs_what_it_has_started(caplog: pytest.LogCaptureFixture) -> None:
    """With the sub-environments of envs that callables have made."""

    def several() -> Any:
        return gym.make_vec("CartPole-v1", 3, "sync")

    config = {"name": "a", "task": several, "num_workers": 2, "placement": "inline"}
    with caplog.at_level("INFO", "rlightning_aio"), sync.build_env_group(config) as group:
        group.init()
        envs = "a: 2 envs of 3 sub-environments, placement inline, 0 worker processes"
        assert repr(group) == f"EnvGroup({envs})"
    assert repr(group) == f"EnvGroup({envs})"
    (text,) = [record.getMessage() for record in caplog.records]
    assert text.startswith("started within ")
    assert text.endswith(envs)
