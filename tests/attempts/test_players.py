"""Which envs of a group are there to play."""

from __future__ import annotations

from typing import Any

from rlightning_aio.attempts.players import Players


class Group:
    """A group whose only worker is given up, and whose server waits for its first client."""

    metas = ()

    def get_workers(self) -> list[dict[str, Any]]:
        gone = {"entry": "a", "env_ids": ["a-0"], "given_up": ["a-0"]}
        return [gone, {"entry": "robots", "env_ids": [], "given_up": []}]


def test_clients_may_come_whatever_other_envs_are_gone() -> None:
    players = Players(Group())
    assert players.can_play(["robots"])
    assert not players.can_play(["robots", "a"])
