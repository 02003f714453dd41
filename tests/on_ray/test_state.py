"""State of envs in actors: taken out, put back, and kept for the case of a death."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import ray_cluster
from faults.test_resume import Episodes, Walk
from group.test_snapshots import Fragile, Run, entry_of
from kit.driven import Driven
from kit.processes import kill

from rlightning_aio import sync
from rlightning_aio.errors import EnvRaised

if TYPE_CHECKING:
    from pathlib import Path

    from kit.driven import Place

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


async def test_a_snapshot_is_a_file_like_any_other(facade: Place, tmp_path: Path) -> None:
    """For an actor that was never reset, too; some envs only, or into others."""
    entry = entry_of("gymnasium", **IN_ACTORS)
    async with facade.build(entry) as group:
        await group.reset(seed=3)
        (tmp_path / "kept").write_bytes(await group.snapshot())
        before, _ = await group.step(group_actions(group))
    async with facade.build(entry) as group:
        await group.restore((tmp_path / "kept").read_bytes())
        after, _ = await group.step(group_actions(group))
        np.testing.assert_equal(after.observation, before.observation)
        snapshot = await group.snapshot(["e-0"])
        shown, _ = await group.restore(snapshot, ["e-1"])
        np.testing.assert_equal(shown.observation[0], after.observation[0])


def group_actions(group: Any) -> Any:
    from rlightning_aio import BatchedData, PolicyResponse

    return BatchedData(group.env_ids, [PolicyResponse(env_id, 1) for env_id in group.env_ids])


class Mortal(Walk):
    """Tells whom to kill."""

    def process(self) -> int:
        return os.getpid()


KEPT = {
    "name": "e",
    "task": Mortal,
    "num_workers": 4,
    "on_worker_death": "resume",
    "snapshot_every": 5,
    "max_restarts": 20,
    **IN_ACTORS,
    "envs_per_process": 2,
}


def test_all_envs_are_restored_or_none() -> None:
    """One fails at it; those in other actors are where they were."""
    entry = {"name": "e", "task": Fragile, "num_workers": 2, **IN_ACTORS}
    with sync.build_env_group(entry) as group:
        batch, _ = group.reset()
        batch, _ = group.step(batch.respond(action=[0, 0]))
        snapshot = group.snapshot()
        batch, _ = group.step(batch.respond(action=[0, 1]))
        with pytest.raises(EnvRaised, match=r"env 'e-1'.*restore.*the disk is gone"):
            group.restore(snapshot)
        batch, _ = group.step(batch.respond(action=[0, 0]))
        assert batch.observation.tolist() == [[3], [3]]
        assert not batch.is_reset.any()


def test_episodes_after_deaths_have_the_returns_of_a_run_without() -> None:
    """Of actors at random turns; no more steps are lost at once than the entry says."""
    group = Driven("sync", KEPT)
    local = {"name": "e", "task": Mortal, "num_workers": 4, "placement": "inline"}
    twins = Driven("sync", local)
    turns = iter(range(10_000))

    def strike() -> bool:
        turn = next(turns)
        if turn in (3, 12, 23):
            kill(group.call(f"e-{turn % 4}", "process"))
        return turn <= 24

    try:
        group.init()
        disturbed = Episodes(group)
        disturbed.run(4, strike)
        twins.init()
        undisturbed = Episodes(twins)
        undisturbed.run(max(map(len, disturbed.ended.values())))
    finally:
        group.end()
        twins.end()
    assert len(disturbed.lost) == 6
    assert 0 < max(disturbed.lost) <= KEPT["snapshot_every"]
    for env_id, episodes in disturbed.ended.items():
        assert episodes == undisturbed.ended[env_id][: len(episodes)]


def test_an_env_whose_node_dies_goes_on_on_another(nodes: Any) -> None:
    """From where it was kept last, shown as a reset; the trainer has what was kept."""
    placed = {"ray_options": {"resources": {"spare": 1}}, "envs_per_process": 2}
    dying = ray_cluster.add_node(nodes, 1, spare=1)
    group = Driven("sync", {**KEPT, **placed, "num_workers": 2})
    other = None
    try:
        group.init()
        batch, _ = group.reset(seed=3)
        shown = []
        while not batch.restarted.any():  # The actor lives for some steps more than its node.
            shown.append(batch.observation)
            if len(shown) == 8:
                other = ray_cluster.add_node(nodes, 1, spare=1)
                nodes.remove_node(dying, allow_graceful=False)
            batch, _ = group.step(batch.respond(action=[0, 0]))
        for k, info in enumerate(batch.info()):
            kept = len(shown) - 1 - info["worker_resumed"]
            np.testing.assert_equal(batch.observation[k], shown[kept][k])
        assert batch.is_reset.all()
    finally:
        group.end()
        if other is not None:
            nodes.remove_node(other)
