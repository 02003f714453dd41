"""Checking and writing actions: values that have no meaning in the space are refused."""

from __future__ import annotations

import warnings
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from kit.scripted import Counts

from rlightning_aio import BatchedData, EnvConfig, PolicyResponse, sync
from rlightning_aio._core.group.engine.actions import write_actions
from rlightning_aio._core.group.state.env_table import EnvTable
from rlightning_aio.batch.data import batch_of_results
from rlightning_aio.errors import BadAction
from rlightning_aio.protocol.slab import RowLayout, Slab

IDS = ["e-0", "e-1", "e-2"]


class Rows:
    """Rows for the actions of three envs; if they are `free`, two of them take any action."""

    def __init__(self, space: Any, *, free: bool = False) -> None:
        config = EnvConfig(name="e", backend="gymnasium", task="x", num_workers=3)
        self.envs: Any = EnvTable([config] * 3, IDS)
        self.envs.actions_beside_rows[[2, 0]] = self.envs.any_beside_rows = free
        layout = RowLayout(spaces.Discrete(2), space, (), ())
        self.slab = Slab(layout, memoryview(bytearray(layout.size(3))), 3)
        self.layout: Any = SimpleNamespace(
            slabs=[self.slab],
            slab=np.zeros(3, np.intp),
            row=np.arange(3),
            row_is_slot=True,
            of=lambda slot: (self.slab, slot),
        )

    def write(self, actions: Any, form: str = "columns") -> Any:
        """Write actions; return what must be sent out of band."""
        slots = np.array([2, 0, 1], np.intp)
        batch = batch_of_results((), self, slots, self.envs.names).respond(actions)
        if form == "values":
            ids = batch.env_ids()
            pairs = zip(ids, actions, strict=True)
            batch = BatchedData(ids, [PolicyResponse(id_, one) for id_, one in pairs])
        return write_actions(batch, slots, self.envs, self.layout)

    @property
    def written(self) -> Any:
        """Return the written actions in the order in which they were given."""
        return self.slab.action[[2, 0, 1]]


INF, NAN = np.inf, np.nan
HALF_BOUNDED = spaces.Box(np.array([0, -INF], "f"), np.array([INF, 1], "f"), dtype=np.float32)
SMALL = spaces.Box(-128, 127, (2,), np.int8)


@pytest.mark.parametrize("form", ["columns", "values"])
@pytest.mark.parametrize(
    ("space", "bad", "held"),
    [
        (SMALL, np.array([1, 300]), "300"),
        (SMALL, np.array([200, 1], np.uint8), "200"),
        (spaces.MultiBinary(2), np.array([1, 2**40]), str(2**40)),
        (spaces.Box(-9, 9, (2,), np.int64), np.array([1, 2**63], np.uint64), str(2**63)),
        (spaces.Box(-9, 9, (2,), np.float32), np.array([1, 1e300]), "1e+300"),
        (spaces.Box(-9, 9, (2,), np.float64), np.array([NAN, 1]), "nan"),
        (spaces.Box(-INF, INF, (2,), np.float32), np.array([1, NAN], np.float16), "nan"),
        (HALF_BOUNDED, np.array([-INF, 0], np.float32), "-inf"),
        (HALF_BOUNDED, np.array([0, INF], np.float16), "inf"),
    ],
    ids=str,
)
def test_meaningless_numbers_are_refused_by_name(
    space: Any, bad: Any, held: str, form: str
) -> None:
    """The error names the env and the position, for columns and for single actions."""
    actions = np.ones((3, 2), bad.dtype)
    actions[1] = bad
    with pytest.raises(BadAction) as caught:
        Rows(space).write(actions, form)
    said = str(caught.value)
    assert said.startswith(
        f"action for env 'e-0' (entry 'e', backend gymnasium, task 'x') holds {held},"
    )
    assert said.endswith("nothing was sent")
    rows = Rows(spaces.Dict(part=space))
    with pytest.raises(BadAction, match=r"action\['part'\] for env 'e-0' .* holds"):
        rows.write(
            {"part": actions} if form == "columns" else [{"part": one} for one in actions], form
        )


class Waiting(Counts):
    """Takes two numbers."""

    def __init__(self, limit: float) -> None:
        self.action_space = spaces.Box(-limit, limit, (2,))

    def does(self, action: Any) -> float:
        return float(action.max())


@pytest.mark.parametrize("order", [("far", "near"), ("near", "far")])
@pytest.mark.parametrize("form", ["columns", "values"])
def test_infinity_is_judged_by_the_space_of_its_own_env(form: str, order: tuple[str, str]) -> None:
    """Whatever the space of the group's first env, whose rows have the same arrays."""
    made = {name: partial(Waiting, limit) for name, limit in (("near", 1), ("far", INF))}
    entries = [EnvConfig(name=n, task=made[n], placement="inline") for n in order]
    with sync.build_env_group(entries) as group:
        batch, _ = group.reset()

        def responses(part: BatchedData, action: Any) -> BatchedData:
            columns = part.respond(action=np.array(action, np.float32))
            return columns if form == "columns" else BatchedData(part.ids(), columns.values())

        far = responses(batch.by_entry()["far"], [[INF, 0]])
        assert group.step(far)[0].reward.tolist() == [INF]
        with pytest.raises(BadAction, match=r"'near-0'.* holds inf"):
            group.step(responses(batch, [[INF, 0], [INF, 0]]))


@pytest.mark.parametrize("form", ["columns", "values"])
def test_a_cast_that_keeps_the_value_is_allowed(form: str) -> None:
    """An int64 for a small dtype, a float64 for a float32, infinity where there is no bound."""
    for space, actions in (
        (SMALL, np.array([[-128, 127], [0, 1], [2, 3]])),
        (spaces.MultiBinary(2), np.array([[0, 1]] * 3)),
        (spaces.Discrete(5), np.array([4, 3, 2], np.uint8)),
        (HALF_BOUNDED, np.array([[INF, -INF], [7, 9], [-3, 0.5]])),
        (spaces.Box(-1, 1, (2,), np.float64), np.full((3, 2), -1e300)),
    ):
        rows = Rows(space)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert rows.write(actions, form) is None
        assert rows.written.tolist() == actions.tolist()
    rows = Rows(spaces.Box(-1, 1, (2,), np.float32))
    rows.write(np.full((3, 2), 0.1), form)
    assert (rows.written == np.float32(0.1)).all()


def test_a_list_holds_one_action_for_each_env() -> None:
    """Even if a Tuple has as many parts as there are envs, its parts are not taken for envs."""
    threes = spaces.Tuple([spaces.Discrete(9), spaces.Discrete(9), spaces.Discrete(9)])
    rows = Rows(spaces.Dict(arm=threes, hand=SMALL))
    drawn = [{"arm": (k, k + 1, k + 2), "hand": np.array([k, -k])} for k in (0, 3, 6)]
    assert rows.write(drawn) is None
    arm, hand = (rows.slab.action[part] for part in ("arm", "hand"))
    assert [part[[2, 0, 1]].tolist() for part in arm] == [[0, 3, 6], [1, 4, 7], [2, 5, 8]]
    assert hand[[2, 0, 1]].tolist() == [[0, 0], [3, -3], [6, -6]]
    rows = Rows(threes)
    rows.write([action["arm"] for action in drawn])
    assert rows.slab.action[1][[2, 0, 1]].tolist() == [1, 4, 7]
    for free in (False, True):  # A tuple of columns has these shapes, too.
        with pytest.raises(BadAction, match=r"env 'e-2' .* give a list with one action for each"):
            Rows(spaces.Box(-9, 9, (3,)), free=free).write((np.arange(3),) * 3)


@given(
    actions=arrays.arrays(
        st.sampled_from([np.float32, np.float64]),
        st.sampled_from([(3, 2), (3, 4000)]),
        elements=st.floats(width=32),
        fill=st.just(1.0),
    )
)
def test_nan_and_values_beyond_a_bound_are_found_in_arrays_of_any_size(
    actions: Any,
) -> None:
    """There are no false alarms, for example for numbers whose squares overflow."""
    box = spaces.Box(-INF, 1, actions.shape[1:], np.float32)
    rows = Rows(box)
    if np.isnan(actions).any() or np.isposinf(actions).any():
        with pytest.raises(BadAction, match=r"holds (nan|inf)"):
            rows.write(actions)
    else:
        rows.write(actions)
        assert (rows.written == actions).all()


@pytest.mark.parametrize("form", ["columns", "values"])
def test_free_actions_travel_beside_their_rows_and_may_be_anything(form: str) -> None:
    """Whether they would fit or not; those of other envs are checked and written."""
    for space, actions in (
        (SMALL, np.array([[1, 2], [1, 300], [3, 4]])),
        (HALF_BOUNDED, np.array([[0, 0], [NAN, INF], [0, 0]], np.float32)),
    ):
        rows = Rows(space, free=True)
        sent = rows.write(actions, form)
        assert sent.positions.tolist() == [0, 1]
        for k, (action, extras) in enumerate(sent.contents):
            assert np.array_equal(action, actions[k], equal_nan=True)
            assert extras == {}
        assert rows.written.tolist() == [[0, 0], [0, 0], actions[2].tolist()]
    with pytest.raises(BadAction, match=r"env 'e-1' .* holds 300"):
        Rows(SMALL, free=True).write(np.array([[1, 300], [1, 2], [300, 4]]), form)


class Tensor:
    """A tensor that can't be converted to an array, such as a sparse one."""

    def __len__(self) -> int:
        return 3

    def detach(self) -> Any:
        raise RuntimeError("no dense layout")


@pytest.mark.parametrize("form", ["columns", "values"])
def test_tensors_that_cannot_become_arrays_are_bad_actions(form: str) -> None:
    """The error is BadAction, not an error of torch."""
    actions = Tensor()
    with pytest.raises(BadAction, match="not an array: no dense layout"):
        Rows(SMALL).write(actions if form == "columns" else [Tensor()] * 3, form)


@pytest.mark.simulators
def test_tensors_without_a_numpy_dtype_are_converted() -> None:
    """For example bfloat16, and views that are marked as negated; others are bad actions."""
    torch = pytest.importorskip("torch")
    box = spaces.Box(-9, 9, (2,), np.float32)
    numbers = [[1.5, -2.0], [0.0, 3.0], [4.0, 5.0]]
    negated = torch.complex(torch.zeros(3, 2), -torch.tensor(numbers)).conj().imag
    assert negated.is_neg()
    for actions in (torch.tensor(numbers, dtype=torch.bfloat16, requires_grad=True), negated):
        for form in ("columns", "values"):
            rows = Rows(box)
            rows.write(actions, form)
            assert rows.written.tolist() == numbers
    for odd in (torch.eye(3, 2).to_sparse(), torch.zeros(3, 2, device="meta")):
        with pytest.raises(BadAction, match="not an array"):
            Rows(box).write(odd)
    with pytest.raises(BadAction, match="not an array"):
        Rows(box).write(torch.zeros(3, 2).to(torch.float8_e5m2))
