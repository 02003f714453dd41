"""HalfCheetahs over three nodes, held against local ones while nodes are killed and added.

Rule: whatever an env of the cluster returns is what its local twin returns, to the last bit. One
that has lost its episode says so, and both are reset with a seed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import ray_cluster

from rlightning_aio import sync

if TYPE_CHECKING:
    from collections.abc import Callable

NUM_ENVS, NUM_ACTORS = 6, 3
SIM = "sim"
"""What only the nodes that may be killed have; the trainer's has none of it."""
PLACED = {
    "placement": "ray",
    "num_cpus": 0,
    "ray_options": {"resources": {SIM: 1}, "scheduling_strategy": "SPREAD"},
}


@dataclass
class Told:
    """What a run was like.

    Attributes:
        steps: transitions that were equal; restarts: results that told of a lost episode.
    """

    steps: int = 0
    restarts: int = 0


def entry(**placed: Any) -> dict[str, Any]:
    return {
        "name": "cheetah",
        "backend": "mujoco",
        "task": "HalfCheetah-v5",
        "num_workers": NUM_ENVS,
        "max_episode_steps": 50,
        **placed,
    }


def add_node(cluster: Any) -> Any:
    """A node with room for two actors."""
    return ray_cluster.add_node(cluster, 1, **{SIM: 2})


def run(cluster: Any, num_batches: int, every: int) -> Told:
    """Step, killing the oldest of three nodes in every so many batches; a new one is added."""
    nodes = [add_node(cluster) for _ in range(3)]

    def strike(number: int) -> None:
        if number % every == every // 2:
            cluster.remove_node(nodes.pop(0), allow_graceful=False)
            nodes.append(add_node(cluster))

    spread = {"envs_per_process": NUM_ENVS // NUM_ACTORS, "max_restarts": 20}
    try:
        with (
            sync.build_env_group(entry(**PLACED, **spread)) as group,
            sync.build_env_group(entry(placement="inline")) as twins,
        ):
            return step_both(group, twins, num_batches, strike)
    finally:
        for node in nodes:
            cluster.remove_node(node)


def step_both(
    group: sync.EnvGroup, twins: sync.EnvGroup, num_batches: int, strike: Callable[[int], None]
) -> Told:
    """Step envs of the cluster and their local twins, and hold them against each other.

    While those of the cluster step, `strike` is called with the number of the batch.
    """
    told, draw = Told(), np.random.default_rng(0)
    batch, _ = group.reset(seed=0)
    equal(batch, twins.reset(seed=0)[0], slice(None))
    with group.auto_reset(), twins.auto_reset():
        for number in range(num_batches):
            action = draw.uniform(-1, 1, (NUM_ENVS, 6))
            group.step_async(batch.respond(action=action))
            strike(number)
            batch, _ = group.collect_async(wait_all=True)
            local, _ = twins.step(batch.respond(action=action))
            check(told, batch, local)
            begin_anew(group, twins, batch, seed=number)
    return told


def check(told: Told, batch: Any, local: Any) -> None:
    """Whoever has lost nothing is equal."""
    kept = ~batch.restarted
    equal(batch, local, kept)
    infos = zip(batch.info(), local.info(), strict=True)
    assert all(here == there for (here, there), same in zip(infos, kept, strict=True) if same)
    told.steps += int(np.sum(kept & ~batch.is_reset))
    told.restarts += int(np.sum(batch.restarted))


def begin_anew(group: Any, twins: Any, batch: Any, seed: int) -> None:
    """Put those that have lost their episode and their twins into one state."""
    lost = [env_id for env_id, gone in zip(batch.ids(), batch.restarted, strict=True) if gone]
    while lost:
        seeds = dict.fromkeys(lost, seed)
        here, _ = group.reset(seed=seeds, env_ids=lost)
        there, _ = twins.reset(seed=seeds, env_ids=lost)
        equal(here, there, slice(None))
        # An actor that died in the reset was asked anew, without the seed.
        lost = [env_id for env_id, gone in zip(lost, here.restarted, strict=True) if gone]


def equal(here: Any, there: Any, which: Any) -> None:
    for name in ("observation", "reward", "terminated", "truncated", "is_reset", "limit_reached"):
        mine, other = getattr(here, name)[which], getattr(there, name)[which]
        np.testing.assert_array_equal(mine, other, strict=True, err_msg=name)
