"""Limits of a Piper arm's actions include their bounds, rounded to float32 and bus units."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio.errors import ConfigError
from rlightning_aio.plugins.piper.options import (
    HALF_UNIT,
    Limit,
    PiperOptions,
    action_limits,
    check_reset_position,
)


@pytest.mark.parametrize(
    ("limit", "value", "sent"),
    [
        (Limit("gripper", 0.0, 0.07), np.float32(0.07), 0.07),
        (Limit("gripper", 0.0, 0.07), 0.07, 0.07),
        (Limit("joint_1", -0.8, 0.8), np.clip(np.float32(1.0), -0.8, 0.8), 0.8),
        (Limit("joint_1", -0.8, 0.8), np.clip(np.float64(-1.0), -0.8, 0.8), -0.8),
        (Limit("rx", -math.pi, math.pi), np.float32(np.pi), math.pi),
        (Limit("rx", -math.pi, math.pi), math.pi + 0.01, 0.01 - math.pi),
        (Limit("rx", 2.8, 3.5), -3.1, math.tau - 3.1),
        (Limit("rz", -0.5, 0.5), math.tau + 0.2, 0.2),
        (Limit("joint_1", -0.8, 0.8), 0.80001, None),
        (Limit("joint_1", -0.8, 0.8), 0.8 + math.tau, None),
        (Limit("rx", 2.8, 3.5), -2.0, None),
        (Limit("gripper", 0.0, 0.07), 0.070002, None),
        (Limit("z", 0.0, 0.8), math.nan, None),
        (Limit("rx", -math.pi, math.pi), math.inf, None),
        (Limit("rx", -math.pi, math.pi), math.nan, None),
    ],
)
def test_values_at_a_bound_are_sent(limit: Limit, value: Any, sent: float | None) -> None:
    """Values that round to a bound are sent as the bound; whole turns are ignored."""
    within = limit.within(float(value))
    if within is None or sent is None:
        assert within == sent
    else:
        assert limit.low <= within <= limit.high
        assert math.remainder(within - sent, math.tau) == pytest.approx(0, abs=1e-6)


BOUNDS = st.tuples(st.floats(-2, 2), st.floats(0.01, 3)).map(lambda pair: (pair[0], sum(pair)))


@given(BOUNDS, st.floats(-8, 8), st.sampled_from(["joint_2", "x", "rx"]))
def test_nothing_beyond_a_bound_is_sent(bounds: Any, value: float, name: str) -> None:
    """The sent value is within the bounds, and equals the given one up to bus units."""
    limit = Limit(name, *bounds)
    sent = limit.within(value)
    if sent is None:
        turned = [value, value - math.tau, value + math.tau] if name == "rx" else [value]
        assert not any(limit.low <= v <= limit.high for v in turned)
        return
    assert limit.low <= sent <= limit.high
    away = value - sent
    if name == "rx":
        away = math.remainder(away, math.tau)
    assert abs(away) <= HALF_UNIT[limit.unit] + 1e-6


@given(BOUNDS)
def test_members_of_the_action_space_are_within(bounds: Any) -> None:
    """The space's bounds are the limits in float32, rounded outwards, and are accepted."""
    limit = Limit("joint_2", *bounds)
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
