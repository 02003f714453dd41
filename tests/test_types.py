"""`EnvRet`, `MultiAgentEnvRet`, `EnvMeta` and `PolicyResponse`, with RLightning's field names."""

from __future__ import annotations

import copy
import pickle
import time
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from pydantic import ValidationError

from rlightning_aio.types import EnvMeta, EnvRet, MultiAgentEnvRet, PolicyResponse


def test_a_reset_needs_only_an_id_and_an_observation() -> None:
    """Other fields have the values of a reset."""
    before = time.time_ns()
    ret = EnvRet(env_id="a-0", observation=np.zeros(3))
    assert (ret.last_reward, ret.last_terminated, ret.last_truncated) == (0.0, False, False)
    assert (ret.info, ret._extra) == ({}, {})
    assert before <= ret.ts_env_sent_ns <= time.time_ns()


@pytest.mark.parametrize("kind", [EnvRet, MultiAgentEnvRet])
def test_extra_is_a_keyword_and_an_attribute(kind: Any) -> None:
    """It can be given, read and replaced, and is copied with the result."""
    ret = kind(env_id="a-0", observation={"x": 1}, _extra={"k": 1})
    assert ret._extra == {"k": 1}
    ret._extra["more"] = 2
    assert pickle.loads(pickle.dumps(ret))._extra == {"k": 1, "more": 2}
    assert copy.deepcopy(ret)._extra == {"k": 1, "more": 2}
    ret._extra = {}
    assert ret._extra == {}


def test_unknown_fields_raise() -> None:
    """So a misspelt field is not lost."""
    with pytest.raises(ValidationError, match="last_rewrad"):
        EnvRet(env_id="a-0", observation=0, last_rewrad=1.0)
    with pytest.raises(ValidationError, match="observation"):
        EnvRet(env_id="a-0")


def test_an_observation_is_kept_unchanged() -> None:
    """It is neither copied nor converted."""
    observation = np.zeros(3, np.float32)
    assert EnvRet(env_id="a-0", observation=observation).observation is observation


def test_a_multi_agent_result_holds_dicts_by_agent() -> None:
    """Other values raise."""
    ret = MultiAgentEnvRet(env_id="a-0", observation={"x": 1, "y": 2})
    assert (ret.last_reward, ret.last_terminated, ret.last_truncated) == ({}, {}, {})
    with pytest.raises(ValidationError, match="observation"):
        MultiAgentEnvRet(env_id="a-0", observation=np.zeros(3))


def test_metadata_default_to_one_single_agent_env() -> None:
    """They have the spaces."""
    meta = EnvMeta(
        env_id="a-0", observation_space=spaces.Box(0, 1, (2,)), action_space=spaces.Discrete(3)
    )
    assert (meta.num_envs, meta.agents, meta.max_episode_steps) == (1, (), None)
    assert pickle.loads(pickle.dumps(meta)) == meta


def test_a_response_has_the_policys_extra_fields() -> None:
    """As attributes, and together as `extras`."""
    response = PolicyResponse("a-0", action=2, log_prob=-0.5, value=1.0)
    assert (response.env_id, response.action, response.log_prob) == ("a-0", 2, -0.5)
    assert response.extras == {"log_prob": -0.5, "value": 1.0}
    assert PolicyResponse("a-0").action is None
    assert "log_prob=-0.5" in repr(response)
    assert pickle.loads(pickle.dumps(response)).extras == response.extras
