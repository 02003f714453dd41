"""`BatchedData`: RLightning's interface over columns."""

from __future__ import annotations

import copy
import pickle
import re
import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio._core.group.state.env_table import EnvTable
from rlightning_aio.batch import BatchedData
from rlightning_aio.batch.columns import ResultColumns
from rlightning_aio.batch.contents import reported_info_list
from rlightning_aio.batch.data import batch_of_results, columns_of_responses, parts_of, slots_of
from rlightning_aio.batch.infos import vector_infos
from rlightning_aio.batch.sent import UNASKED, columns_of_values, copied
from rlightning_aio.config import EnvConfig
from rlightning_aio.errors import BadAction
from rlightning_aio.protocol.info import INFO_BYTES, PICKLED, InfoSchema, InfoSchemas, InfoWriter
from rlightning_aio.protocol.slab import IS_RESET, OVER, TERMINATED, TRUNCATED
from rlightning_aio.types import EnvRet, MultiAgentEnvRet, PolicyResponse

PENDULUMS, GRIDS = (
    EnvConfig(name=name, backend="gymnasium", task="x", num_workers=n)
    for name, n in (("pendulum", 3), ("grid-world", 2))
)
IDS = ["pendulum-0", "pendulum-1", "pendulum-2", "grid-world-0", "grid-world-1"]
NAMES = EnvTable([PENDULUMS] * 3 + [GRIDS] * 2, IDS).names
NAMES.index_offset[:] = range(5)


def flags(head: tuple[int, ...], **which: Any) -> Any:
    """Return a column of flags with the named ones set."""
    column = np.zeros((*head, 4), bool)
    for name, values in which.items():
        column[..., FLAGS[name]] = values
    return column


FLAGS = {"terminated": TERMINATED, "truncated": TRUNCATED, "is_reset": IS_RESET, "over": OVER}


def columns(
    slots: list[int],
    observation: Any,
    positions: list[int] | None = None,
    *,
    agents: tuple[str, ...] = (),
    **fields: Any,
) -> ResultColumns:
    """Return results of `slots` with rewards 0.5, 1.5, …, without ends and infos."""
    n = len(slots)
    head = (n, len(agents)) if agents else (n,)
    values: dict[str, Any] = {
        "slots": np.array(slots, np.intp),
        "names": NAMES,
        "positions": None if positions is None else np.array(positions, np.intp),
        "observation": observation,
        "reward": np.arange(np.prod(head)).reshape(head) + 0.5,
        "flags": flags(head),
        "info_marks": np.zeros(n, np.uint8),
        "info": None,
        "schemas": [{} for _ in IDS],
        "out_of_band": {},
        "episode_return": None,
        "episode_length": None,
        "times": np.arange(2 * n).reshape(n, 2),
        "agents": agents,
    }
    return ResultColumns(**{**values, **fields})


class Group:
    """Stands for a group; remembers what it has stopped."""

    def __init__(self) -> None:
        self.stopped: list[int] = []

    def stop_hardware(self, slots: Any) -> None:
        self.stopped += slots


GROUP = Group()


def results(*parts: ResultColumns, sources: Any = None, group: Any = GROUP) -> BatchedData:
    size = sum(map(len, parts))
    slots = np.zeros(size, np.intp)
    for part in parts:
        slots[range(size) if part.positions is None else part.positions] = part.slots
    names = parts[0].names if parts else NAMES
    return batch_of_results(parts, group, slots, names, sources)


def mixed() -> BatchedData:
    """Return results of envs of two entries with different observation shapes, interleaved."""
    pendulums = columns([0, 2], np.array([[0.0, 1.0], [2.0, 3.0]]), [0, 2])
    grids = columns([4, 3], np.array([7, 8]), [1, 3])
    return results(pendulums, grids)


# -- ids and values


@given(pairs=st.lists(st.tuples(st.sampled_from("abc"), st.integers())))
def test_ids_and_values_keep_their_order(pairs: list[tuple[str, int]]) -> None:
    """Ids may repeat; a look-up by id returns the first value."""
    batch = BatchedData([id_ for id_, _ in pairs], [value for _, value in pairs])
    assert batch.items() == list(batch) == pairs
    assert (batch.ids(), batch.values(), len(batch)) == (
        [id_ for id_, _ in pairs],
        [value for _, value in pairs],
        len(pairs),
    )
    for id_ in "abc":
        assert (id_ in batch) == (id_ in batch.ids())
        if id_ in batch:
            assert batch[id_] == pairs[batch.ids().index(id_)][1]
        else:
            with pytest.raises(KeyError, match=id_):
                batch[id_]


def test_every_value_has_an_id() -> None:
    """Otherwise it raises."""
    with pytest.raises(ValueError, match="2 ids for 1 values"):
        BatchedData(["a", "b"], [1])


# -- columns of results


def test_columns_need_no_values() -> None:
    """They are the given arrays, and each value is a row of them."""
    observation = np.arange(6.0).reshape(3, 2)
    batch = results(columns([2, 0, 1], observation))
    assert batch.observation is observation
    assert batch.reward.tolist() == [0.5, 1.5, 2.5]
    assert batch.terminated.dtype == batch.truncated.dtype == bool
    assert batch.ids() == ["pendulum-2", "pendulum-0", "pendulum-1"]
    value = batch["pendulum-0"]
    assert isinstance(value, EnvRet)
    assert value.observation.tolist() == [2.0, 3.0]
    assert (value.last_reward, value.last_terminated, value.last_truncated) == (1.5, False, False)
    assert [type(v) for v in (value.last_reward, value.last_terminated)] == [float, bool]
    assert batch["pendulum-0"] is value


def test_different_observation_spaces_do_not_stack() -> None:
    """Other columns do, in the order of the batch; the error says what to do."""
    batch = mixed()
    assert batch.ids() == ["pendulum-0", "grid-world-1", "pendulum-2", "grid-world-0"]
    assert batch.reward.tolist() == [0.5, 0.5, 1.5, 1.5]
    with pytest.raises(ValueError, match=r"by_entry\(\)"):
        batch.observation  # noqa: B018
    assert [value.env_id for value in batch.values()] == batch.ids()


def test_each_entry_of_a_mixed_batch_stacks() -> None:
    """Names may contain dashes; the order is kept; responses go to their envs."""
    split = mixed().by_entry()
    assert list(split) == ["pendulum", "grid-world"]
    assert split["pendulum"].observation.tolist() == [[0.0, 1.0], [2.0, 3.0]]
    assert split["grid-world"].observation.tolist() == [7, 8]
    assert split["grid-world"].ids() == ["grid-world-1", "grid-world-0"]
    assert split["grid-world"].reward.tolist() == [0.5, 1.5]
    responses = split["grid-world"].respond(action=np.array([3, 4]))
    assert [(id_, r.action) for id_, r in responses] == [("grid-world-1", 3), ("grid-world-0", 4)]
    ids = ["robots-0/arm-left", "a/b-10", "robots-1/left-3/x", "own-id", "id"]
    assert list(BatchedData(ids, ids).by_entry()) == ["robots", "a/b", "own", "id"]
    plain = BatchedData(["grid-world-0", "pendulum-1"], [1, 2]).by_entry()
    assert {name: part.values() for name, part in plain.items()} == {
        "grid-world": [1],
        "pendulum": [2],
    }


def test_a_multi_agent_batch_has_columns_by_agent() -> None:
    """And its values are dicts by agent."""
    observation = {"ann": np.zeros((2, 3)), "bob": np.ones((2, 1))}
    batch = results(columns([0, 1], observation, agents=("ann", "bob")))
    assert {agent: r.tolist() for agent, r in batch.reward.items()} == {
        "ann": [0.5, 2.5],
        "bob": [1.5, 3.5],
    }
    value = batch["pendulum-1"]
    assert isinstance(value, MultiAgentEnvRet)
    assert value.last_reward == {"ann": 2.5, "bob": 3.5}
    assert value.observation["bob"].tolist() == [1.0]


def test_observations_out_of_band_stack_if_possible() -> None:
    """Strings stay a list; arrays with the same shape become an array."""
    texts = results(
        columns([0, 1], None, out_of_band={0: {"observation": "a"}, 1: {"observation": "b"}})
    )
    assert texts.observation == ["a", "b"]
    arrays = results(
        columns([0, 1], None, out_of_band={k: {"observation": np.full(2, k)} for k in range(2)})
    )
    assert arrays.observation.tolist() == [[0, 0], [1, 1]]


def test_a_batch_of_plain_results_has_columns() -> None:
    """As made by hand in tests of a policy."""
    batch = BatchedData.from_dict(
        {
            f"a-{k}": EnvRet(
                env_id=f"a-{k}",
                observation={"x": np.full(2, k)},
                last_reward=k,
                info={"k": k},
                _extra={"e": k},
            )
            for k in range(3)
        }
    )
    assert batch.observation["x"].tolist() == [[0, 0], [1, 1], [2, 2]]
    assert batch.reward.tolist() == [0, 1, 2]
    assert batch.terminated.tolist() == batch.truncated.tolist() == [False] * 3
    assert batch.info() == [{"k": 0}, {"k": 1}, {"k": 2}]


# -- responses


def test_columns_become_responses() -> None:
    """Each row goes to the env of the result in that row, with all extras."""
    batch = mixed()
    responses = batch.respond(action=np.arange(4), log_prob=np.arange(4) / 2, tag=list("abcd"))
    assert responses.ids() == batch.ids()
    assert responses.action.tolist() == [0, 1, 2, 3]
    second = responses["grid-world-1"]
    assert isinstance(second, PolicyResponse)
    assert (second.env_id, second.action, second.extras) == (
        "grid-world-1",
        1,
        {"log_prob": 0.5, "tag": "b"},
    )


@pytest.mark.parametrize(
    "space",
    [
        spaces.Dict(move=spaces.Box(-1, 1, (2,)), jump=spaces.Discrete(2)),
        spaces.Tuple([spaces.Box(-1, 1, (2,)), spaces.MultiBinary(3)]),
    ],
    ids=["dict", "tuple"],
)
def test_actions_may_be_trees_of_columns(space: Any) -> None:
    """With one column of n rows for each array of the space."""
    from gymnasium.vector.utils import batch_space

    batch = results(columns([0, 1, 2], np.zeros((3, 1))))
    actions = batch_space(space, 3).sample()
    responses = batch.respond(action=actions)
    assert all(value.action in space for value in responses.values())


@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((1, 4)), {"a": np.zeros(5)}, 7, [1]])
def test_a_column_has_a_row_for_each_result(bad: Any) -> None:
    """The error names the column."""
    with pytest.raises(BadAction, match=r"'action' (has \d rows|is 7) for a batch of 2"):
        results(columns([0, 1], np.zeros((2, 1)))).respond(action=bad)
    with pytest.raises(BadAction, match=r"'value' (has|is)"):
        results(columns([0, 1], np.zeros((2, 1)))).respond(action=np.zeros(2), value=bad)


def test_hardware_stops_when_its_batch_of_responses_is_refused() -> None:
    """The group never hears of these actions."""
    group = Group()
    with pytest.raises(BadAction):
        results(columns([0, 1], np.zeros((2, 1))), group=group).respond(action=None)
    assert group.stopped == [0, 1]


def test_plain_batches_can_be_answered() -> None:
    """By the ids of their envs."""
    batch = BatchedData(
        ["server", "server"], [EnvRet(env_id=f"s/{k}", observation=k) for k in (1, 2)]
    )
    assert [r.env_id for r in batch.respond(action=[1, 2]).values()] == ["s/1", "s/2"]


def test_values_without_a_fixed_size_are_a_list() -> None:
    """Of any lengths, even if they are equal."""
    space = spaces.Dict(
        items=spaces.Sequence(spaces.Discrete(9)), pair=spaces.Tuple([spaces.Discrete(9)] * 2)
    )
    values = [{"items": (1, 2), "pair": (3, 4)}, {"items": (5, 6), "pair": (7, 8)}]
    part = columns([0, 1], None, out_of_band=dict(enumerate({"observation": v} for v in values)))
    part.observation_space = space
    observation = results(part).observation
    assert observation["items"] == [(1, 2), (5, 6)]
    assert [column.tolist() for column in observation["pair"]] == [[3, 7], [4, 8]]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ({"a": 1}, {"b": 1}),
        ({"a": 1}, 1),
        ((1, 2), (1, 2, 3)),
        ((1, 2), 5),
        (np.zeros(2), np.zeros(3)),
    ],
)
def test_values_of_different_structure_do_not_stack(one: Any, other: Any) -> None:
    """The error says what to do, for any difference."""
    batch = BatchedData(
        ["a-0", "b-0"],
        [EnvRet(env_id="a-0", observation=one), EnvRet(env_id="b-0", observation=other)],
    )
    with pytest.raises(ValueError, match=r"by_entry\(\)"):
        batch.observation  # noqa: B018


# -- flags of rows


def test_agents_with_sub_environments_have_their_flags() -> None:
    """What is of an env is of each of its sub-environments, and ends are of each agent."""
    names = replace(NAMES, index_offset=np.arange(5) * 3)
    ends = np.random.default_rng(0).random((3, 2, 3)) < 0.5
    resets = np.array([[True, False, False], [False, True, True], [False, False, False]])
    parts = [
        columns(
            slots,
            dict.fromkeys("ab", np.zeros(len(rows))),
            rows,
            names=names,
            agents=("a", "b"),
            reward=np.zeros((len(rows), 2, 3)),
            flags=flags((len(rows), 2, 3), terminated=ends[rows], is_reset=resets[rows][:, None]),
            restarted=np.array(rows) == 2,
        )
        for slots, rows in (([4, 0], [0, 2]), ([3], [1]))
    ]
    batch = results(*parts)
    assert batch.index.tolist() == [[12, 13, 14], [9, 10, 11], [0, 1, 2]]
    assert batch.is_reset.tolist() == resets.tolist()
    assert batch.restarted.tolist() == [[False] * 3] * 2 + [[True] * 3]
    assert np.stack([*batch.done.values()], axis=1).tolist() == ends.tolist()
    assert batch.by_entry()["grid-world"].is_reset.tolist() == resets[:2].tolist()


def test_columns_of_flags_belong_to_the_reader() -> None:
    """Writing to them changes nothing else."""
    batch = results(columns([0, 1], np.zeros((2, 1))))
    for name in ("limit_reached", "restarted"):
        getattr(batch, name)[:] = True
        assert not getattr(batch, name).any()


def test_rows_of_different_shapes_have_no_common_column() -> None:
    """The error says what to do."""
    batch = results(
        columns([0], np.zeros((1, 1)), [0]),
        columns([3], np.zeros((1, 1)), [1], reward=np.zeros((1, 2)), flags=flags((1, 2))),
    )
    with pytest.raises(ValueError, match=r"by_entry\(\)"):
        batch.is_reset  # noqa: B018
    assert [part.is_reset.shape for part in batch.by_entry().values()] == [(1,), (1, 2)]


@pytest.mark.parametrize("name", ["is_reset", "limit_reached", "restarted", "index", "sent"])
def test_plain_values_have_no_columns_of_a_group(name: str) -> None:
    """Neither have responses."""
    for batch in (BatchedData(["a"], [1]), mixed().respond(action=np.zeros(4))):
        with pytest.raises(AttributeError, match="only results of a group"):
            getattr(batch, name)


# -- sent columns


def sent_for(n: int, *requests: Any, of_rows: list[int], rows: list[int]) -> Any:
    """Return the sent columns of `n` results that answer these requests."""
    of_each = np.empty(n, object)
    of_each[:] = [requests[k] for k in of_rows]
    return results(columns(list(range(n)), None), sources=(of_each, np.array(rows))).sent


def plain(value: Any) -> Any:
    """The value without arrays."""
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, tuple):
        return tuple(map(plain, value))
    return np.array(value, object).tolist()


def test_rows_without_a_request_have_none_among_several_forms() -> None:
    """In a list, which holds None for them, and in an array of objects."""
    of_rows, rows = [0, 1, 2], [0, 0, 1]
    pushes = {"push": np.array([[1.5, 2.5], [3.5, 4.5]]), "jump": np.array([0, 1])}
    requests = [None, {"action": pushes}, {"action": ["seven", "eight"]}]
    found = sent_for(3, *requests, of_rows=of_rows, rows=rows).action
    assert plain(tuple(found)) == (None, {"push": [1.5, 2.5], "jump": 0}, "eight")
    objects = {"action": np.array([{}, []], object)}
    assert sent_for(2, None, objects, of_rows=[1, 0], rows=[1, 0]).action.tolist() == [[], None]


@pytest.mark.parametrize("values", [[6, "x"], ["x", 6], [[1, "a"], [2, "b"]], [b"\0", b"x"]])
def test_single_responses_with_texts_stay_values(values: list[Any]) -> None:
    """In an array, numbers would become texts."""
    responses = [PolicyResponse(f"a-{k}", v, extra={"it": v}) for k, v in enumerate(values)]
    found = columns_of_values(responses)
    assert found["action"] == found["extra"]["it"] == values


def test_sent_tensors_stay_tensors() -> None:
    """On their device; rows without a request have NaN, or 0 if the dtype has no NaN."""
    torch = pytest.importorskip("torch")
    sent = sent_for(
        3,
        None,
        {"value": torch.tensor([1.0, 2.0]), "choice": torch.tensor([3, 4])},
        {"value": torch.tensor([5.0]), "choice": torch.tensor([6])},
        of_rows=[2, 0, 1],
        rows=[0, 0, 1],
    )
    assert torch.equal(sent.value.nan_to_num(-1.0), torch.tensor([5.0, -1.0, 2.0]))
    assert torch.equal(sent.choice, torch.tensor([6, 0, 4]))


def test_sent_tensors_are_copies() -> None:
    """Like arrays."""
    torch = pytest.importorskip("torch")
    tensor = torch.zeros(2)
    kept = copied(tensor)
    tensor += 1
    assert kept.tolist() == [0, 0]


def test_single_responses_become_columns() -> None:
    """If they stack; otherwise lists, with None for missing values."""
    responses = [
        PolicyResponse("a-0", np.zeros(2), log_prob=0.5, thought="x"),
        PolicyResponse("a-1", np.ones(2), log_prob=1.5),
    ]
    found = columns_of_values(responses)
    assert found["action"].tolist() == [[0, 0], [1, 1]]
    assert found["log_prob"].tolist() == [0.5, 1.5]
    assert found["thought"] == ["x", None]
    ragged = columns_of_values([PolicyResponse("a-0", np.zeros(2)), PolicyResponse("a-1", 3)])
    assert [np.shape(action) for action in ragged["action"]] == [(2,), ()]


def test_the_error_for_an_unknown_name_lists_the_sent_ones() -> None:
    """Also if nothing was sent for a row, or for none."""
    requests = {"action": np.ones(1)}, {"action": np.ones(1), "value": np.ones(1)}
    sent = sent_for(2, *requests, of_rows=[0, 1], rows=[0, UNASKED])
    assert (sent.action[0], np.isnan(sent.action[1])) == (1, True)
    with pytest.raises(AttributeError, match=r"no 'valeu' was sent.*action"):
        sent.valeu  # noqa: B018
    sent = sent_for(1, requests[1], of_rows=[0], rows=[0])
    assert repr(sent) == "Sent(1 rows: action, value)"
    with pytest.raises(AttributeError, match=r"no 'valeu' was sent.*action, value"):
        sent.valeu  # noqa: B018
    with pytest.raises(KeyError, match="nothing"):
        sent_for(1, None, of_rows=[0], rows=[0])["action"]


def test_a_batch_without_requests_has_the_columns_sent_last() -> None:
    """With their shapes and dtypes; other names are columns of NaN."""
    example = {"action": np.zeros((3, 2), int), "log_prob": np.zeros(3), "thought": ["x"] * 3}
    of_each = np.full(2, None, object)
    of_each[:] = [example] * 2
    sent = results(columns([0, 1], None), sources=(of_each, np.full(2, UNASKED))).sent
    assert list(sent) == ["action", "log_prob", "thought"]
    assert sent.action.tolist() == [[0, 0], [0, 0]]
    assert sent.action.dtype == int
    assert np.isnan(sent.log_prob).tolist() == [True, True]
    assert sent.thought == [None, None]
    assert np.isnan(sent.value).tolist() == [True, True]


# -- infos


plain_infos = st.fixed_dictionaries(
    {},
    optional={
        "count": st.integers(-9, 9),
        "speed": st.floats(width=32, allow_nan=False).map(np.float32),
        "won": st.booleans(),
        "sure": st.booleans().map(np.bool_),
        "position": st.lists(st.integers(0, 9), min_size=2, max_size=2).map(np.array),
        "odd": st.one_of(st.integers(0, 9), st.floats(0, 1)),
        "_count": st.integers(0, 9),
        "episode": st.integers(0, 9),
    },
)


@given(st.lists(st.lists(plain_infos, min_size=1, max_size=4), min_size=1, max_size=3))
def test_infos_in_rows_become_the_same_columns_as_single_infos(
    workers: list[list[dict[str, Any]]],
) -> None:
    """With types, for any distribution of envs over workers, which number schemas on their own."""
    infos = [info for own in workers for info in own]
    rows, marks = np.zeros((len(infos), INFO_BYTES), np.uint8), np.zeros(len(infos), np.uint8)
    schemas: list[dict[int, InfoSchema]] = []
    for own in workers:
        known: dict[int, InfoSchema] = {}
        announced = InfoSchemas(known.__setitem__)
        for info in own:
            row = len(schemas)
            marks[row] = InfoWriter(memoryview(rows[row]), announced.announce).write(info)
            schemas.append(known)
    slots = list(range(len(infos)))
    part = columns(slots, None, info=rows, info_marks=marks, schemas=schemas)
    assert repr(reported_info_list(results(part))) == repr(infos)
    found, expected = results(part).infos, vector_infos(infos)
    assert found.keys() == expected.keys()
    for key, column in expected.items():
        assert found[key].dtype == column.dtype, key
        np.testing.assert_array_equal(found[key], column)


any_value = st.one_of(
    st.integers(),
    st.integers(-9, 9),
    st.floats(allow_nan=False),
    st.booleans(),
    st.booleans().map(np.bool_),
    st.integers(0, 9).map(np.uint8),
    st.floats(0, 1, width=32).map(np.float32),
    st.integers(0, 9).map(lambda value: np.array([value, 1])),
    st.floats(0, 1).map(lambda value: np.array([value, 1.0])),
    st.text(max_size=2),
    st.text("ab", min_size=1, max_size=3).map(lambda value: np.array([value, "a"])),
    st.none(),
)
any_key = st.sampled_from(["a", "_a", "__a", "b", "final_obs", 1, None, ("c", 2)])
any_infos = st.dictionaries(any_key, any_value | st.dictionaries(any_key, any_value, max_size=2))


def infos_of(infos: list[dict[Any, Any]]) -> dict[Any, Any]:
    contents = {k: {"info": info} for k, info in enumerate(infos)}
    return results(columns(list(range(len(infos))), None, out_of_band=contents)).infos


def check_columns(found: dict[Any, Any], infos: list[dict[Any, Any]]) -> None:
    """Check that each value is in its row, under its key, and that masks are correct."""
    keys = {key for info in infos for key in info}
    masks = {f"_{key}" for key in keys}
    assert found.keys() == keys | masks
    for mask in masks:
        has = [any(f"_{key}" == mask for key in info) for info in infos]
        assert found[mask].dtype == np.bool_
        assert found[mask].tolist() == has
    for key in keys - masks:
        own = {k: info[key] for k, info in enumerate(infos) if key in info}
        if isinstance(found[key], dict):
            assert key != "final_obs"
            check_columns(found[key], [info.get(key, {}) for info in infos])
            continue
        for k, value in own.items():
            np.testing.assert_array_equal(found[key][k], value)


@given(st.lists(any_infos, min_size=1, max_size=4))
def test_no_info_changes_or_hides_another(infos: list[dict[Any, Any]]) -> None:
    """With any types and keys, in any order."""
    found = infos_of(infos)
    check_columns(found, infos)
    reverse = infos_of(infos[::-1])

    def check_reverse(one: Any, other: Any) -> None:
        if isinstance(one, dict):
            assert one.keys() == other.keys()
            for key in one:
                check_reverse(one[key], other[key])
        else:
            assert one.dtype == other.dtype
            assert repr(one.tolist()) == repr(other[::-1].tolist())

    check_reverse(found, reverse)


alike = {
    "a": st.integers(-9, 9),
    1: st.floats(allow_nan=False),
    ("b", 2): st.integers(0, 9).map(lambda value: np.array([value, 1])),
    "c": st.text(max_size=2),
    "sure": st.booleans().map(np.bool_),
    "won": st.booleans(),
    "final_obs": st.integers(0, 3) | st.just({"place": 1}),
}


@given(
    st.lists(
        st.fixed_dictionaries(
            {}, optional={**alike, "nested": st.fixed_dictionaries({}, optional=alike)}
        ),
        min_size=1,
        max_size=4,
    )
)
def test_values_of_one_type_become_gymnasiums_columns(infos: list[dict[Any, Any]]) -> None:
    """Compared with Gymnasium's code."""
    from gymnasium.vector import VectorEnv

    vector, expected = VectorEnv[Any, Any, Any](), dict[Any, Any]()
    vector.num_envs = len(infos)
    for k, info in enumerate(infos):
        expected = vector._add_info(expected, info, k)
    assert_same_infos(infos_of(infos), expected)


def assert_same_infos(found: Any, expected: Any) -> None:
    """Check for equal keys, dtypes and values."""
    assert type(found) is type(expected)
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for key in expected:
            assert_same_infos(found[key], expected[key])
    else:
        assert (found.dtype, repr(found)) == (expected.dtype, repr(expected))


without_odd = plain_infos.map(
    lambda info: {k: v for k, v in info.items() if k not in ("odd", "_count")}
)
"""Infos with one type for each key, and no key with the name of a mask."""


@given(
    infos=st.lists(st.lists(without_odd, min_size=3, max_size=3), min_size=1, max_size=3),
    in_rows=st.booleans(),
)
def test_infos_of_sub_environments_have_their_own_masks(
    infos: list[list[dict[str, Any]]], in_rows: bool
) -> None:
    """Like those of one vector environment, with another axis."""
    of_envs = [vector_infos(own) for own in infos]
    slots = list(range(len(infos)))
    rows, marks = np.zeros((len(slots), INFO_BYTES), np.uint8), np.zeros(len(slots), np.uint8)
    known: dict[int, InfoSchema] = {}
    announce = InfoSchemas(known.__setitem__).announce if in_rows else lambda _: PICKLED
    for row, info in enumerate(of_envs):
        marks[row] = InfoWriter(memoryview(rows[row]), announce).write(info)
    part = columns(
        slots,
        None,
        info=rows,
        info_marks=marks,
        schemas=[known] * len(slots),
        out_of_band={k: {"info": of_envs[k]} for k in slots if marks[k] == PICKLED},
    )
    found, expected = results(part).infos, vector_infos([info for own in infos for info in own])
    assert found.keys() == expected.keys()
    for key in [key for key in expected if not key.startswith("_")]:
        mask = expected["_" + key].reshape(len(slots), 3)
        np.testing.assert_array_equal(found["_" + key], mask)
        np.testing.assert_array_equal(found[key][mask], expected[key][mask.reshape(-1)])


def test_one_key_of_all_infos_is_a_column() -> None:
    """A list if its values differ in shape; missing keys have the default."""
    infos = [{"a": 1.5, "b": [1]}, {"a": 2.5, "b": [1, 2]}, {"b": [], "c": None}]
    batch = results(
        columns([0, 1, 2], None, out_of_band={k: {"info": info} for k, info in enumerate(infos)})
    )
    assert batch.info() == infos
    assert batch.info("b") == [[1], [1, 2], []]
    assert batch.info("a", 0.0).tolist() == [1.5, 2.5, 0.0]
    assert batch.info("c", None).tolist() == [None] * 3
    with pytest.raises(KeyError, match=r"the info of pendulum-2 has no 'a'; give a default"):
        batch.info("a")
    plain = BatchedData(
        ["a-0", "a-1"], [EnvRet(env_id=f"a-{k}", observation=0, info={"k": k}) for k in range(2)]
    )
    assert plain.info("k").tolist() == [0, 1]
    assert plain.infos["k"].tolist() == [0, 1]


# -- copies


def contents(batch: BatchedData) -> str:
    """Return all contents of a batch of results."""
    columns = (batch.reward, batch.terminated, batch.truncated, batch.done)
    rows = (batch.is_reset, batch.limit_reached, batch.restarted, batch.index)
    sent = {name: batch.sent[name] for name in batch.sent}
    split = {name: (part.ids(), part.observation) for name, part in batch.by_entry().items()}
    values = [(value.model_dump(), value._extra) for value in batch.values()]
    return repr((list(batch.ids()), batch.env_ids(), columns, rows, sent, split, values))


COPIES = (copy.copy, copy.deepcopy, lambda batch: pickle.loads(pickle.dumps(batch)))


@pytest.mark.parametrize("copied", COPIES)
@pytest.mark.parametrize("read", [False, True])
def test_a_batch_can_be_copied_and_pickled(copied: Any, read: bool) -> None:
    """After any reads, and without the group, which then uses the ids."""
    schema = InfoSchema.of({"speed": 1.5})
    assert schema is not None
    speeds = np.arange(2.0).view(np.uint8).reshape(2, 8)
    infos = {"info": speeds, "info_marks": np.array([1, 1], np.uint8)}
    schemas = [{}, {}, {}, {1: schema}, {1: schema}]
    out_of_band = {0: pickle.dumps({"info": {"nested": {"a": 1}}, "extra": {"k": 2}})}
    group = threading.Lock()
    batch = results(
        columns([0, 2], np.array([[0.0, 1.0], [2.0, 3.0]]), [0, 2], out_of_band=out_of_band),
        columns([4, 3], np.array([7, 8]), [1, 3], schemas=schemas, **infos),
        sources=(np.full(4, {"action": np.arange(4)}), np.arange(4)[::-1]),
        group=group,
    )
    expected = contents(copy.deepcopy(batch))
    assert "'speed': 1.0" in expected
    if read:
        assert contents(batch) == expected
    found = copied(batch)
    assert contents(found) == expected
    assert slots_of(found, group) is None
    response = copied(batch.respond(action=np.arange(4), value=[1, None, 2, 3]))
    assert response.env_ids() == batch.env_ids()
    assert [value.value for value in response.values()] == [1, None, 2, 3]
    plain = copied(BatchedData(["a", "a"], [1, 2]))
    assert plain.items() == [("a", 1), ("a", 2)]


# -- the group of a batch, and its text


def test_only_the_group_of_a_batch_uses_its_slots() -> None:
    """Another group uses the ids."""
    group = object()
    batch = results(columns([2, 0], np.zeros((2, 1))), group=group)
    slots = slots_of(batch, group)
    assert slots is not None
    assert slots.tolist() == [2, 0]
    assert slots_of(batch, object()) is slots_of(BatchedData(), group) is None
    responses = batch.respond(action=np.zeros(2), value=np.ones(2))
    assert slots_of(responses, group) is slots
    columns_ = columns_of_responses(responses)
    assert columns_ is not None
    assert list(columns_) == ["action", "value"]
    assert columns_of_responses(batch) is None
    assert len(parts_of(batch)) == 1
    assert parts_of(responses) == parts_of(BatchedData()) == ()


def test_the_text_of_a_batch_has_shapes_and_no_contents() -> None:
    """The first ids, and dtype and shape of each column."""
    shown = repr(mixed())
    assert shown.startswith("BatchedData(4 results of pendulum-0, grid-world-1, pendulum-2, …,")
    assert "observation: float64[2, 2], reward: float64[2]" in shown
    assert "observation: int64[2]" in shown
    tree = {"a": np.zeros((1, 3), np.float32), "b": (np.zeros(1, bool),)}
    assert "{a: float32[1, 3], b: (bool[1])}" in repr(results(columns([0], tree)))
    responses = mixed().respond(action=np.zeros((4, 2)), tag=list("abcd"))
    assert re.search(r"4 responses of .*action: float64\[4, 2\], tag: list\[4\]", repr(responses))
    assert repr(BatchedData(["a", "b"], [1, 2])) == "BatchedData(2 values of a, b)"


# -- special batches


def test_an_empty_batch_of_results_has_columns() -> None:
    """Such as a step of no envs in a group of several layouts."""
    batch = results()
    for name in ("reward", "done", "is_reset", "limit_reached", "restarted", "index", "outcome"):
        assert len(getattr(batch, name)) == 0
    assert not (batch.terminated | batch.truncated).any()


def test_tensors_that_do_not_stack_can_be_attached_to_responses() -> None:
    """They are kept as a list, like arrays."""
    torch = pytest.importorskip("torch")
    found = columns_of_values(
        [
            PolicyResponse("a-0", torch.zeros(1), memory=torch.zeros(2)),
            PolicyResponse("a-1", torch.zeros(1), memory=torch.zeros(3)),
            PolicyResponse("a-2", torch.zeros(1)),
        ]
    )
    assert found["action"].shape == (3, 1)
    assert [None if m is None else len(m) for m in found["memory"]] == [2, 3, None]
