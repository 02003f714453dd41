"""Evaluate a policy on a server of openpi, which returns chunks of actions."""

from rlightning_aio import sync
from rlightning_aio.errors import PolicyServerError
from rlightning_aio.evaluation import evaluate
from rlightning_aio.plugins.openpi import OpenPiPolicy
from rlightning_aio.policies import ActionChunks


def observe(observation, info):
    """What the model expects."""
    return {"observation/state": observation, "prompt": info.get("task", "")}


URL = "ws://localhost:9"  # Nobody is there; scripts/serve_policy.py listens on 8000.
with (
    OpenPiPolicy(URL, observe, connect_timeout=0) as policy,
    sync.build_env_group("CartPole-v1") as group,
):
    try:
        print(evaluate(group, ActionChunks(policy), episodes=1))
    except PolicyServerError as error:
        print(error)
