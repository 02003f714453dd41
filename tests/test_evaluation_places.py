"""`evaluate` with clients: places that are empty, and clients that leave."""

from __future__ import annotations

from collections import Counter
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from kit.counting import ClientThread, CountingEnv
from patience import HANG

from rlightning_aio import sync
from rlightning_aio.evaluation import EpisodeSpec, Evaluation, evaluate

if TYPE_CHECKING:
    from collections.abc import Iterator

    import rlightning_aio as rl
    from rlightning_aio.types import EnvRet


class Counting(CountingEnv):
    """Two steps end an episode. It leaves after a number of resets, if that is given."""

    def __init__(self, leaves_after: int = 0) -> None:
        super().__init__()
        self.leaves_after = leaves_after

    def ret(self) -> EnvRet:
        ret = super().ret()
        ret.last_terminated = self.steps == 2
        return ret

    def is_finish(self) -> bool:
        has_left = bool(self.leaves_after) and self.resets >= self.leaves_after
        return super().is_finish() or has_left


@contextmanager
def served(names: str, connect_timeout: float = HANG) -> Iterator[tuple[sync.EnvGroup, list[Any]]]:
    """Two places, of a and b, and the envs of the clients with these names, which all end."""
    kwargs = {"clients": ["a", "b"], "connect_timeout": connect_timeout}
    entry = {"name": "r", "backend": "env_server", "env_kwargs": kwargs}
    with sync.build_env_group(entry) as group:
        address: str = group["r-0"].address
        clients = [ClientThread(address, name, Counting(), hardware=False) for name in names]
        yield group, [client.env for client in clients]
    for client in clients:
        client.join()


def nothing(batch: rl.BatchedData) -> Any:
    return np.zeros((len(batch), 2))


def ends(found: Evaluation) -> Counter[tuple[str, str]]:
    return Counter((one.outcome.kind, one.env_id) for one in found.attempts)


def test_episodes_of_an_empty_place_have_failed() -> None:
    """They are no silence, and nobody waits for the client while the others play."""
    with served("a") as (group, _):
        group.reset(env_ids=["r-0/a"])
        found = evaluate(group, nothing, 2)
        assert ends(found) == {("terminated", "r-0/a"): 2, ("env_away", "r-0/b"): 2}
        assert {one.outcome.cause for one in found.failed} == {
            "no client is there that could play it"
        }
        found = evaluate(group, nothing, [EpisodeSpec("", seed) for seed in range(3)])
        assert ends(found) == {("terminated", "r-0/a"): 3}


def test_clients_that_leave_together_fail_their_episodes() -> None:
    """One error names several places, and what waits for them is not given to them."""
    with served("ab", connect_timeout=0.5) as (group, envs):
        group.reset()
        for env in envs:
            env.leaves_after = 2
        found = evaluate(group, nothing, 3, min_results=2, retries=1)
    assert ends(found) == {("env_away", f"r-0/{name}"): 3 for name in "ab"}
    assert sum(len(one.failures) for one in found.attempts) == 0


def test_an_episode_is_tried_again_on_whoever_is_left() -> None:
    with served("ab", connect_timeout=0.5) as (group, envs):
        group.reset()
        envs[0].leaves_after = 2
        specs = [EpisodeSpec("", seed) for seed in range(6)]
        found = evaluate(group, nothing, specs, min_results=1)
    assert ends(found) == {("terminated", "r-0/b"): 6}
    (lost,) = [one for attempt in found.attempts for one in attempt.failures]
    assert (lost.kind, lost.env_id) == ("env_away", "r-0/a")
