"""Envs of workers and of this process are in one group, but they don't share failures."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import pytest
from kit.tokens import Tokens, entry, marked

from rlightning_aio.errors import EnvRaised

if TYPE_CHECKING:
    from collections.abc import Callable

    from kit.driven import Driven

    Start: TypeAlias = Callable[..., Driven]

ENTRIES = [entry(1), entry(1, placement="inline", name="here")]
THEIRS, OURS = "faulty-0", "here-0"


def test_death_of_a_worker_affects_only_its_own_envs(start: Start) -> None:
    """Those of this process continue to step."""
    group, tokens = start(ENTRIES), Tokens()
    for _ in range(2):
        batch, _ = group.step(tokens.steps([THEIRS, OURS], {THEIRS: "exit 3"}))
        theirs, ours = batch.values()
        assert marked(theirs)
        assert theirs.info["worker_restarted"].startswith("exited with code 3")
        assert not marked(ours)
        batch, _ = group.step(tokens.steps([THEIRS, OURS]))
        assert not any(map(marked, batch.values()))


def test_error_on_one_side_loses_nothing_of_the_other(start: Start) -> None:
    """Whichever of the two raises."""
    group, tokens = start(ENTRIES), Tokens()
    for env_id, other in ((THEIRS, OURS), (OURS, THEIRS)):
        with pytest.raises(EnvRaised, match=f"env '{env_id}'") as caught:
            group.step(tokens.steps([THEIRS, OURS], {env_id: "raise"}))
        assert caught.value.results is not None
        assert caught.value.results.ids() == [other]
        group.reset(env_ids=[env_id])
