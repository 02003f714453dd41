"""Which envs of a group are there to play."""

from __future__ import annotations

from typing import Any

from rlightning_aio.attempts.players import Players
from rlightning_aio.types import EnvMeta


class Group:
    """A group whose only worker is given up, and a server with an empty place."""

    metas = tuple(
        EnvMeta(env_id=env_id, observation_space=None, action_space=None)
        for env_id in ("a-0", "robots-0/0")
    )

    def get_workers(self) -> list[dict[str, Any]]:
        gone = {"entry": "a", "env_ids": ["a-0"], "given_up": ["a-0"], "state": "given up"}
        place = {"entry": "robots", "env_ids": ["robots-0/0"], "given_up": [], "state": "empty"}
        return [gone, place]


def test_clients_may_come_whatever_other_envs_are_gone() -> None:
    players = Players(Group())
    assert players.can_play(["robots"])
    assert not players.can_play(["robots", "a"])
