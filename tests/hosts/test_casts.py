"""What is converted to the dtype of its space is noted, and nothing else."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from kit.scripted import GO, RAISE, Scripted

from rlightning_aio import sync
from rlightning_aio._core.hosts.messages import CASTS
from rlightning_aio._core.hosts.running.casts import Cast, Casts
from rlightning_aio.protocol.columns import Leaf, Misfit

FLOAT, INT = np.dtype(np.float32), np.dtype(np.int64)
KEPT = [
    (np.zeros(2, FLOAT), FLOAT),
    (np.float32(0.1), FLOAT),
    (3, INT),
    (np.int64(3), INT),
]
CONVERTED = [
    (np.full(2, 0.1), FLOAT, "float64", True),
    (np.full(2, 0.5), FLOAT, "float64", False),
    (np.full(2, np.nan), FLOAT, "float64", False),
    (np.full(2, 1e300), FLOAT, "float64", True),
    (np.full(2, 2**24 + 1), FLOAT, "int64", True),
    (np.full(2, 3), np.dtype(np.int8), "int64", False),
    (np.full(2, True), INT, "bool", False),
    (np.full(2, 1.0, ">f4"), FLOAT, ">f4", False),
    (0.1, FLOAT, "float", True),
    ([1, 2], INT, "list", False),
    ((0.1, 0.2), FLOAT, "tuple", True),
]


@pytest.mark.parametrize(("value", "dtype"), KEPT)
def test_what_has_the_dtype_of_its_space_is_no_cast(value: Any, dtype: np.dtype[Any]) -> None:
    """A number of Python has the dtype that NumPy gives it."""
    casts = Casts()
    casts.fitted(value, Leaf(("x",), np.shape(value), dtype), "observation")
    assert casts.found() == []


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize(("value", "dtype", "found", "rounds"), CONVERTED)
def test_what_is_converted_is_noted_once(
    value: Any, dtype: np.dtype[Any], found: str, rounds: bool
) -> None:
    """It says whether any number has changed."""
    casts, leaf = Casts(), Leaf(("x",), np.shape(value), dtype)
    for _ in range(2):
        casts.fitted(value, leaf, "observation")
    assert casts.found() == [Cast("observation['x']", found, str(dtype), rounds)]


def test_what_does_not_fit_is_an_error_as_ever() -> None:
    """Nothing is noted then."""
    casts = Casts()
    with pytest.raises(Misfit, match="found shape"):
        casts.fitted(np.full(3, 0.1), Leaf((), (2,), FLOAT), "observation")
    assert casts.found() == []


class Narrowed(Scripted):
    """Returns float64 where its space has float32."""

    observation_space = gym.spaces.Box(-9, 9, (2,))

    def observed(self) -> Any:
        return np.full(2, 0.1) if self.steps else np.zeros(2, FLOAT)


@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("placement", ["inline", "process"])
def test_an_env_that_was_rebuilt_is_looked_at_as_well(placement: str) -> None:
    """The first call begins, and later ones return what was found since then."""
    entry = {"name": "e", "task": Narrowed, "placement": placement, "on_env_error": "restart"}
    with sync.build_env_group({**entry, "backend": "callable"}) as group:
        batch, _ = group.reset(seed=0)
        batch, _ = group.step(batch.respond(action=[GO]))
        casts = group["e-0"].call
        assert casts(CASTS) == []
        batch, _ = group.step(batch.respond(action=[RAISE]))
        assert group.num_restarts == 1
        batch, _ = group.reset(seed=0)
        assert casts(CASTS) == []
        batch, _ = group.step(batch.respond(action=[GO]))
        assert batch.observation.dtype == FLOAT
        assert casts(CASTS) == [Cast("observation", "float64", "float32", rounds=True)]
