"""`BatchedData`: RLightning's interface over columns that nobody has to unpack."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio.batch import BatchedData, Origin, ResultColumns
from rlightning_aio.config import EnvConfig
from rlightning_aio.errors import BadAction
from rlightning_aio.group.slots import Slots
from rlightning_aio.protocol.info import InfoSchema
from rlightning_aio.types import EnvRet, MultiAgentEnvRet, PolicyResponse

PENDULUMS, GRIDS = (
    EnvConfig(name=name, backend="gymnasium", task="x", num_workers=n)
    for name, n in (("pendulum", 3), ("grid-world", 2))
)
IDS = ["pendulum-0", "pendulum-1", "pendulum-2", "grid-world-0", "grid-world-1"]
TABLE = Slots([PENDULUMS] * 3 + [GRIDS] * 2, IDS)


def columns(
    slots: list[int],
    observation: Any,
    positions: list[int] | None = None,
    *,
    agents: tuple[str, ...] = (),
    **fields: Any,
) -> ResultColumns:
    """Results of `slots` with rewards 0.5, 1.5, …, nothing ended and no infos."""
    n = len(slots)
    head = (n, len(agents)) if agents else (n,)
    values: dict[str, Any] = {
        "slots": np.array(slots, np.intp),
        "table": TABLE,
        "positions": None if positions is None else np.array(positions, np.intp),
        "observation": observation,
        "reward": np.arange(np.prod(head)).reshape(head) + 0.5,
        "ends": np.zeros((*head, 2), bool),
        "info_marks": np.zeros(n, np.uint8),
        "info": None,
        "schemas": [{} for _ in IDS],
        "rests": {},
        "episode_return": None,
        "episode_length": None,
        "times": np.arange(2 * n).reshape(n, 2),
        "agents": agents,
    }
    return ResultColumns(**{**values, **fields})


def results(*parts: ResultColumns) -> BatchedData:
    size = sum(map(len, parts))
    slots = np.zeros(size, np.intp)
    for part in parts:
        slots[range(size) if part.positions is None else part.positions] = part.slots
    return BatchedData.of_results(parts, Origin("a group", slots, TABLE))


def mixed() -> BatchedData:
    """Envs of two entries whose observations have different shapes, interleaved."""
    pendulums = columns([0, 2], np.array([[0.0, 1.0], [2.0, 3.0]]), [0, 2])
    grids = columns([4, 3], np.array([7, 8]), [1, 3])
    return results(pendulums, grids)


# -- ids and values


@given(pairs=st.lists(st.tuples(st.sampled_from("abc"), st.integers())))
def test_ids_and_values_keep_their_order(pairs: list[tuple[str, int]]) -> None:
    """An id may come more than once; looked up by id, its first value is found."""
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


def test_a_batch_is_made_of_a_mapping() -> None:
    """In the mapping's order."""
    batch = BatchedData.from_dict({"b": 1, "a": 2})
    assert list(batch) == [("b", 1), ("a", 2)]


def test_every_value_has_an_id() -> None:
    """What can't be paired is refused."""
    with pytest.raises(ValueError, match="2 ids for 1 values"):
        BatchedData(["a", "b"], [1])


def test_an_empty_batch_is_a_batch() -> None:
    """There is nothing in it."""
    batch = BatchedData()
    assert (len(batch), batch.ids(), batch.values(), list(batch)) == (0, [], [], [])


# -- columns of results


def test_columns_are_there_before_any_value_is() -> None:
    """They are the very arrays that came, and each value is a row of them."""
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


def test_dict_and_tuple_observations_are_trees_of_columns() -> None:
    """Whole and one by one."""
    tree = {"a": np.array([1, 2]), "b": (np.zeros((2, 3)), np.ones((2, 1)))}
    batch = results(columns([0, 1], tree))
    assert batch.observation is tree
    one = batch["pendulum-1"].observation
    assert one["a"] == 2
    assert [part.tolist() for part in one["b"]] == [[0.0, 0.0, 0.0], [1.0]]


def test_different_observation_spaces_do_not_stack() -> None:
    """All else does, in the batch's order; the error says what to do."""
    batch = mixed()
    assert batch.ids() == ["pendulum-0", "grid-world-1", "pendulum-2", "grid-world-0"]
    assert batch.reward.tolist() == [0.5, 0.5, 1.5, 1.5]
    with pytest.raises(ValueError, match=r"by_name\(\)"):
        batch.observation  # noqa: B018
    assert [value.env_id for value in batch.values()] == batch.ids()


def test_each_entry_of_a_mixed_batch_stacks() -> None:
    """Names may hold dashes; order is kept; responses find their way."""
    split = mixed().by_name()
    assert list(split) == ["pendulum", "grid-world"]
    assert split["pendulum"].observation.tolist() == [[0.0, 1.0], [2.0, 3.0]]
    assert split["grid-world"].observation.tolist() == [7, 8]
    assert split["grid-world"].ids() == ["grid-world-1", "grid-world-0"]
    assert split["grid-world"].reward.tolist() == [0.5, 1.5]
    responses = split["grid-world"].respond(action=np.array([3, 4]))
    assert [(id_, r.action) for id_, r in responses] == [("grid-world-1", 3), ("grid-world-0", 4)]
    plain = BatchedData(["grid-world-0", "pendulum-1"], [1, 2]).by_name()
    assert {name: part.values() for name, part in plain.items()} == {
        "grid-world": [1],
        "pendulum": [2],
    }


def test_infos_are_decoded_for_the_env_they_are_of() -> None:
    """From the row by its worker's schema, from the channel, or empty."""
    schema = InfoSchema.of({"x": 1.5})
    assert schema is not None
    rows = np.zeros((3, schema.size), np.uint8)
    rows[0] = np.frombuffer(np.float64(2.5).tobytes(), np.uint8)
    batch = results(
        columns(
            [0, 1, 2],
            np.zeros((3, 2)),
            info=rows,
            info_marks=np.array([1, 255, 0], np.uint8),
            schemas=[{1: schema}, {}, {}, {}, {}],
            rests={1: {"info": {"text": "hi"}}},
        )
    )
    assert batch.info == [{"x": 2.5}, {"text": "hi"}, {}]
    assert [value.info for value in batch.values()] == batch.info


def test_an_episode_that_ended_is_told_with_its_last_result() -> None:
    """Its return and length lie in the info of that result alone."""
    ends = np.array([[False, False], [True, False]])
    batch = results(
        columns(
            [0, 1],
            np.zeros((2, 2)),
            ends=ends,
            episode_return=np.array([9.0, 4.5]),
            episode_length=np.array([7, 3]),
        )
    )
    assert batch.info == [{}, {"episode": {"r": 4.5, "l": 3}}]
    assert batch.ended.tolist() == [False, True]
    assert batch["pendulum-1"].last_terminated is True


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


def test_observations_that_came_one_by_one_stack_where_they_can() -> None:
    """Strings stay a list, arrays of one shape become an array."""
    texts = results(columns([0, 1], None, rests={0: {"observation": "a"}, 1: {"observation": "b"}}))
    assert texts.observation == ["a", "b"]
    arrays = results(
        columns([0, 1], None, rests={k: {"observation": np.full(2, k)} for k in range(2)})
    )
    assert arrays.observation.tolist() == [[0, 0], [1, 1]]


def test_a_batch_of_plain_results_has_columns_too() -> None:
    """Made by hand, as in tests of a policy."""
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
    assert batch.info == [{"k": 0}, {"k": 1}, {"k": 2}]


# -- responses


def test_columns_become_the_matching_responses() -> None:
    """Each row goes to the env whose result stood there, with everything attached."""
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
    """One of n rows for each array of the space."""
    from gymnasium.vector.utils import batch_space

    batch = results(columns([0, 1, 2], np.zeros((3, 1))))
    actions = batch_space(space, 3).sample()
    responses = batch.respond(action=actions)
    assert all(value.action in space for value in responses.values())


@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((1, 4)), {"a": np.zeros(5)}, 7, [1]])
def test_a_column_has_a_row_for_each_result(bad: Any) -> None:
    """The column at fault is named."""
    with pytest.raises(BadAction, match=r"'action' has \d rows for a batch of 2"):
        results(columns([0, 1], np.zeros((2, 1)))).respond(action=bad)
    with pytest.raises(BadAction, match="'value' has"):
        results(columns([0, 1], np.zeros((2, 1)))).respond(action=np.zeros(2), value=bad)


def test_plain_batches_are_answered_alike() -> None:
    """By the ids of the envs in them."""
    batch = BatchedData(
        ["server", "server"], [EnvRet(env_id=f"s/{k}", observation=k) for k in (1, 2)]
    )
    assert [r.env_id for r in batch.respond(action=[1, 2]).values()] == ["s/1", "s/2"]


def test_values_without_a_fixed_size_come_as_a_list() -> None:
    """However long each is, also where they happen to be of one length."""
    space = spaces.Dict(
        items=spaces.Sequence(spaces.Discrete(9)), pair=spaces.Tuple([spaces.Discrete(9)] * 2)
    )
    values = [{"items": (1, 2), "pair": (3, 4)}, {"items": (5, 6), "pair": (7, 8)}]
    part = columns([0, 1], None, rests=dict(enumerate({"observation": v} for v in values)))
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
def test_what_differs_in_structure_does_not_stack(one: Any, other: Any) -> None:
    """It is said what to do, whatever the difference."""
    batch = BatchedData(
        ["a-0", "b-0"],
        [EnvRet(env_id="a-0", observation=one), EnvRet(env_id="b-0", observation=other)],
    )
    with pytest.raises(ValueError, match=r"by_name\(\)"):
        batch.observation  # noqa: B018
