"""TorchRL's own wrapper around the vector interface."""

from __future__ import annotations

from typing import Any

import pytest

from rlightning_aio.vector import make_vec

pytestmark = [
    pytest.mark.simulators,
    # It warns of its own actions.
    pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning"),
]


@pytest.fixture(autouse=True)
def torchrl() -> Any:
    return pytest.importorskip("torchrl")


@pytest.mark.parametrize("mode", ["Disabled", "SameStep"])
def test_its_wrapper_feeds_a_collector(mode: str) -> None:
    """Steps match the specs, and frames of a collector continue over episode ends."""
    from torchrl.collectors import Collector
    from torchrl.envs import GymWrapper
    from torchrl.envs.utils import check_env_specs

    vector = make_vec(
        "HalfCheetah-v5", 2, vector_kwargs={"autoreset_mode": mode}, max_episode_steps=7
    )
    env = GymWrapper(vector)
    check_env_specs(env)
    collector = Collector(env, env.rand_action, frames_per_batch=40, total_frames=120)
    batches = list(collector)
    collector.shutdown()
    assert [batch.batch_size for batch in batches] == [(2, 20)] * 3
    for batch in batches:
        assert batch["next", "done"].any()
        # The last observation belongs to its episode, the next one begins another.
        ended = batch["next", "done"][:, :-1, 0]
        assert (batch["next", "observation"][:, :-1] != batch["observation"][:, 1:])[ended].any()
        going = ~ended
        assert (batch["next", "observation"][:, :-1] == batch["observation"][:, 1:])[going].all()
    assert vector.closed
