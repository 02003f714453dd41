"""Limits of a Piper arm's actions include their bounds, rounded to float32 and bus units."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rlightning_aio.errors import ConfigError
from rlightning_aio.plugins.piper.options import (
    HALF_UNIT,
    Limit,
    PiperOptions,
    action_limits,
    check_reset_position,
)

BOUNDS = st.tuples(st.floats(-2, 2), st.floats(0.01, 3)).map(lambda pair: (pair[0], sum(pair)))
NAMES = st.sampled_from(["joint_2", "x", "gripper", "rx"])
AWAY = st.floats(-2e-5, 2e-5) | st.floats(-8, 8) | st.sampled_from([math.nan, math.inf, -math.inf])


@settings(max_examples=300)
@given(BOUNDS, NAMES, st.booleans(), AWAY, st.integers(-1, 1), st.sampled_from([float, np.float32]))
def test_nothing_beyond_a_bound_is_sent(
    bounds: Any, name: str, high: bool, away: float, turns: int, kind: Any
) -> None:
    """The sent value is within the bounds, and equals the given one up to bus units; whole turns
    of an orientation are ignored.
    """
    limit = Limit(name, *bounds)
    value = float(kind(bounds[high] + away + turns * math.tau))
    sent = limit.within(value)
    if sent is None:
        turned = [value + k * math.tau for k in range(-3, 4)] if name == "rx" else [value]
        assert not any(limit.low <= v <= limit.high for v in turned)
        return
    assert limit.low <= sent <= limit.high
    left = value - sent
    if name == "rx":
        left = math.remainder(left, math.tau)
    assert abs(left) <= HALF_UNIT[limit.unit] + 1e-6


@given(BOUNDS, NAMES)
def test_members_of_the_action_space_are_within(bounds: Any, name: str) -> None:
    """The space's bounds are the limits in float32, rounded outwards, and are accepted."""
    limit = Limit(name, *bounds)
    assert float(limit.low32) <= limit.low
    assert float(limit.high32) >= limit.high
    assert limit.within(float(limit.low32)) == limit.low
    assert limit.within(float(limit.high32)) == limit.high


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"limits": {"joint_2": (0.2, 1.2)}}, r"reset_joints: joint_2 = 0 rad is outside \[0.2"),
        ({"limits": {"gripper": (0.01, 0.05)}}, r"reset_gripper: gripper = 0.0 m is outside"),
        ({"reset_joints": (0, 0, 1, 0, 0, 0)}, r"reset_joints: joint_3 = 1.* rad is outside"),
    ],
)
def test_a_reset_position_must_be_within_the_limits(fields: dict[str, Any], message: str) -> None:
    """Also the default one, so that an arm isn't driven out of a narrowed workspace."""
    with pytest.raises(ConfigError, match=f"arm-0: env_kwargs.{message}.*within the limits"):
        check_reset_position("arm-0", PiperOptions(**fields))


def test_orientations_may_be_bounded_around_half_a_turn() -> None:
    """Where the hand points down; positions stay within the arm's reach."""
    options = PiperOptions(control="end_pose", limits={"rx": (2.8, 3.5)})
    assert action_limits("arm-0", options)[3] == Limit("rx", 2.8, 3.5)
    wide = PiperOptions(control="end_pose", limits={"rx": (-4.0, 4.0)})
    with pytest.raises(ConfigError, match=r"rx: .* not within the arm's own"):
        action_limits("arm-0", wide)
