"""The vector interface beside Gymnasium's own: whatever is done to both, they do the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import given
from hypothesis import strategies as st
from vector.toys import assert_alike, toy

from rlightning_aio.errors import EnvRaised
from rlightning_aio.vector import VectorEnv

SIZE = 3
MODES = list(AutoresetMode)
seeds = st.none() | st.integers(0, 99) | st.lists(
    st.none() | st.integers(0, 99), min_size=SIZE, max_size=SIZE + 1
)  # fmt: skip
masks = st.lists(st.booleans(), min_size=SIZE, max_size=SIZE).map(np.array)
doings = st.one_of(
    st.tuples(st.just("step"), st.lists(st.integers(0, 2), min_size=SIZE, max_size=SIZE)),
    st.tuples(st.just("step"), st.lists(st.integers(0, 2), min_size=SIZE, max_size=SIZE)),
    st.tuples(st.just("reset"), seeds, st.none() | masks),
    st.tuples(st.just("call"), st.sampled_from([("double", 2.0), ("own",), ("no_such",)])),
    st.tuples(st.just("get_attr"), st.sampled_from(["speed", "own", "render_mode"])),
    st.tuples(
        st.just("set_attr"),
        st.sampled_from(["speed", "own"]),
        st.sampled_from([0.5, [1.0, 2.0, 3.0], (1.0, 2.0)]),
    ),
    st.tuples(st.just("render")),
)
histories = st.tuples(
    st.lists(doings, min_size=1, max_size=25),
    st.just([("close",)]),
    st.lists(doings | st.tuples(st.just("close")), max_size=3),
).map(lambda parts: [doing for part in parts for doing in part])


def outcome(env: Any, doing: tuple[Any, ...], due: np.ndarray) -> Any:
    """What comes of it: a result, or that it is refused."""
    what, *arguments = doing
    if what == "step" and env.autoreset_mode == AutoresetMode.DISABLED and due.any():
        what, arguments = "reset", [None, due.copy()]
    try:
        if what == "step":
            return env.step(np.array(arguments[0]))
        if what == "reset":
            seed, mask = arguments
            options = None if mask is None else {"reset_mask": mask, "more": 1}
            return env.reset(seed=seed, options=options)
        if what == "call":
            return env.call(*arguments[0])
        if what == "get_attr":
            return env.get_attr(*arguments)
        if what == "set_attr":
            return env.set_attr(*arguments)
        return env.close() if what == "close" else env.render()
    except ClosedEnvironmentError:
        return "closed"
    except (ValueError, TypeError) as error:
        return type(error).__name__
    except (EnvRaised, AttributeError):  # What an env raises goes by another name here.
        return "an env raised"


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.value)
@given(did=histories, seed=st.integers(0, 99))
def test_whatever_is_done_to_both_they_do_the_same(
    mode: AutoresetMode, did: list[Any], seed: int
) -> None:
    """Resets with seeds and masks, steps over ends, calls, attributes, frames, refusals.

    What is closed is refused, as by Gymnasium's processes; its loop doesn't look.
    """
    ours = VectorEnv([toy] * SIZE, autoreset_mode=mode, placement="inline")
    theirs = SyncVectorEnv([toy] * SIZE, autoreset_mode=mode)
    due = np.zeros(SIZE, np.bool_)
    assert_alike(ours.reset(seed=seed), theirs.reset(seed=seed))
    for turn, doing in enumerate(did):
        refused = ours.closed and doing[0] != "close"
        found = outcome(ours, doing, due)
        expected = "closed" if refused else outcome(theirs, doing, due)
        assert_alike(found, expected, f"{turn}: {doing}")
        if isinstance(expected, tuple) and len(expected) == 5 and doing[0] == "step":
            due = expected[2] | expected[3]
        elif doing[0] == "reset" and isinstance(expected, tuple):
            due = due & ~doing[2] if doing[2] is not None else np.zeros(SIZE, np.bool_)
        elif doing[0] == "step" and isinstance(expected, tuple):
            due = np.zeros(SIZE, np.bool_)
