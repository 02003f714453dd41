"""State of envs in actors: taken out and put back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from group.test_snapshots import Fragile, Run, entry_of

from rlightning_aio import sync
from rlightning_aio.errors import EnvRaised

pytestmark = pytest.mark.ray

IN_ACTORS = {"placement": "ray", "num_cpus": 0, "envs_per_process": 1}
PLACES: dict[str, dict[str, Any]] = {
    "ray": IN_ACTORS,
    "inline": {"placement": "inline"},
    "process": {"placement": "process"},
}


@pytest.mark.parametrize("kind", ["mujoco, several", "of its own"])
def test_a_restored_env_continues_as_the_original(kind: str) -> None:
    """To the last bit: in its actor, in another place, and from there in an actor."""
    groups = {name: sync.build_env_group(entry_of(kind, **at)) for name, at in PLACES.items()}
    with groups["ray"] as one, groups["inline"], groups["process"]:
        run = Run(one, 5)
        first, _ = one.reset(seed=5)
        with one.auto_reset(7):
            batch, _ = run.proceed(first, 10, 0)
            snapshot = one.snapshot()
            _, expected = run.proceed(batch, 20, 1)
            shown, _ = one.restore(snapshot)
            np.testing.assert_equal(shown.observation, batch.observation)
            np.testing.assert_equal(run.proceed(shown, 20, 1)[1], expected)
        for name in ("inline", "process", "ray"):
            group = groups[name]
            group.reset()  # It has been elsewhere, and has made its parts.
            with group.auto_reset(7):
                shown, _ = group.restore(snapshot)
                snapshot = group.snapshot()
                np.testing.assert_equal(Run(group, 5).proceed(shown, 20, 1)[1], expected)


def test_an_env_that_cannot_be_restored_is_lost_and_the_others_are_restored() -> None:
    """Also those in other actors."""
    entry = {"name": "e", "task": Fragile, "num_workers": 2, **IN_ACTORS}
    with sync.build_env_group(entry) as group:
        batch, _ = group.reset()
        batch, _ = group.step(batch.respond(action=[0, 0]))
        snapshot = group.snapshot()
        batch, _ = group.step(batch.respond(action=[0, 1]))
        with pytest.raises(EnvRaised, match=r"env 'e-1'.*restore.*the disk is gone"):
            group.restore(snapshot)
        batch, _ = group.step(batch.respond(action=[0, 0]))
        assert batch.observation.tolist() == [[2], [0]]
        assert batch.restarted.tolist() == [False, True]
