"""Rows and their flags, however a result gets there."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio._core.hosts.running.row_writer import RowWriter, infos_out_of_band
from rlightning_aio._core.hosts.running.runner import EnvRunner
from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.simulators.gymnasium import GymnasiumEnv
from rlightning_aio.protocol.entries import Operation
from rlightning_aio.protocol.info import INFO_BYTES, NO_INFO, PICKLED, InfoSchema, InfoSchemas
from rlightning_aio.protocol.slab import RowLayout, Slab

if TYPE_CHECKING:
    from rlightning_aio.types import Autoreset

CONFIG = EnvConfig(name="plain", backend="gymnasium", task="x")
SPACE = spaces.Box(-99, 99, (2,), np.float64)
ORIGIN = np.zeros(2)

infos = st.one_of(
    st.just({}),
    st.fixed_dictionaries({"x": st.floats(-9, 9)}),
    st.fixed_dictionaries({"x": st.integers(-9, 9), "where": st.just(np.arange(3.0))}),
    # Infos that don't fit a row: nested, a text, an int of more than 64 bits, and a large one.
    st.just({"nested": {"a": [1]}}),
    st.just({"text": "hi"}),
    st.just({"x": 1 << 70}),
    st.just({"large": np.zeros(INFO_BYTES)}),
)
steps = st.tuples(st.integers(-9, 9), st.booleans(), st.booleans(), infos)
histories = st.lists(
    st.one_of(st.tuples(st.just("reset"), infos), st.tuples(st.just("step"), steps))
)


class Scripted(gym.Env[Any, Any]):
    """Returns what the test set; its observation counts resets and steps."""

    observation_space = SPACE
    action_space = spaces.Discrete(3)

    def __init__(self) -> None:
        self.count = 0
        self.next: Any = None
        self.seeds: list[int | None] = []

    def _observation(self) -> Any:
        self.count += 1
        return np.array([self.count, -self.count], float)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.seeds.append(seed)
        return self._observation(), self.next

    def step(self, action: Any) -> Any:
        reward, terminated, truncated, info = self.next
        return self._observation(), reward, terminated, truncated, info


class Plain(GymnasiumEnv):
    mode = AutoresetMode.DISABLED

    def _make(self) -> Any:
        env = Scripted()
        env.metadata = {"autoreset_mode": self.mode}
        return env


class Renewed(Plain):
    """The observation of a step that ends an episode begins the next one."""

    mode = AutoresetMode.SAME_STEP


def begin(
    writer: RowWriter, info: Any, observation: Any = ORIGIN, extra: dict[str, Any] | None = None
) -> Any:
    return writer.write_reset((observation, 0.0, False, False, info), 0, extra)


def step(
    writer: RowWriter,
    reward: Any,
    terminated: Any,
    truncated: Any,
    info: Any,
    observation: Any = ORIGIN,
) -> Any:
    return writer.write_step((observation, reward, terminated, truncated, info), 0)


def new_slab(layout: RowLayout, rows: int = 2) -> Slab:
    return Slab(layout, memoryview(bytearray(layout.size(rows))), rows)


class Row:
    """Row 1 of a slab, and the schemas that its writer announced."""

    def __init__(self, layout: RowLayout) -> None:
        self.slab = new_slab(layout)
        self.schemas: dict[int, InfoSchema] = {}
        self.announce = InfoSchemas(self.schemas.__setitem__).announce

    def info(self, out_of_band: Any) -> Any:
        mark = int(self.slab.info_mark[1])
        if mark in (NO_INFO, PICKLED):
            return (out_of_band or {}).get("info", {})
        return self.schemas[mark].decode(memoryview(self.slab.info[1]))

    def contents(self, out_of_band: Any) -> str:
        slab = self.slab
        length = int(slab.episode_length[1])
        return repr(
            (
                slab.observation[1],
                slab.reward[1],
                slab.flags[1],
                length,
                # Without a step there is nothing that it could be the sum of.
                slab.episode_return[1] if length else None,
                int(slab.info_mark[1]),
                self.info(out_of_band),
                out_of_band,
            )
        )


def runner_and_row(
    kind: type[Plain] = Plain, *, inline: bool = False
) -> tuple[EnvRunner, Scripted, Row]:
    """Return the runner of a plain env, which takes the short way."""
    runner = EnvRunner(kind(CONFIG), inline=inline)
    row = Row(runner.layout)
    runner.attach(row.slab, 1, row.announce)
    return runner, runner.env.env, row


@pytest.mark.parametrize("kind", [Plain, Renewed])
@given(history=histories)
def test_the_short_way_writes_the_same_rows(kind: type[Plain], history: list[Any]) -> None:
    """This holds for ends, steps after an end, resets at any time, and infos of any kind."""
    runner, env, row = runner_and_row(kind)
    long = Row(runner.layout)
    mode = runner.meta.autoreset
    writer = RowWriter(long.slab, 1, env_id="plain-0", autoreset=mode, announce=long.announce)
    for count, (what, then) in enumerate(history, 1):
        observation = np.array([count, -count], float)
        if what == "reset":
            env.next = then
            found = runner.execute(Operation.RESET, None)
            expected = begin(writer, then, observation)
        else:
            row.slab.action[1] = 2
            env.next = then
            found = runner.step()
            reward, terminated, truncated, info = then
            expected = step(writer, float(reward), terminated, truncated, info, observation)
        assert row.contents(found) == long.contents(expected)
        assert not row.slab.flags[0].any()
        assert row.slab.done_ns[1] >= row.slab.busy_ns[1] >= 0


def test_a_reward_is_one_number_in_any_form() -> None:
    """An array of one element is a number, as on the long way; an error names other values."""
    runner, env, row = runner_and_row()
    for number, reward in enumerate((2, np.float32(2), np.array(2.0), np.array([2.0])), 1):
        env.next = reward, False, False, {}
        runner.step()
        assert (row.slab.reward[1], row.slab.episode_return[1]) == (2, 2 * number)
    for reward, message in (
        ({}, r"reward of env 'plain-0' must be a number, not {}"),
        (np.zeros(2), r"reward of env 'plain-0' has shape \(2,\), expected \(\)"),
    ):
        env.next = reward, False, False, {}
        with pytest.raises(ValueError, match=message):
            runner.step()
    env.next = None, False, False, {}  # As Gymnasium's vector envs have it.
    runner.step()
    assert np.isnan(row.slab.reward[1])


# -- what a row says, in each mode


def writer_of(
    mode: Autoreset, head: tuple[int, ...], agents: tuple[str, ...] = (), **fields: Any
) -> tuple[RowWriter, Slab]:
    slab = new_slab(RowLayout(SPACE, spaces.Discrete(2), head, agents), 1)
    fields = {"env_id": "e-0", "announce": infos_out_of_band, **fields}
    return RowWriter(slab, 0, autoreset=mode, **fields), slab


def test_a_sub_environment_resets_itself_for_all_of_its_agents() -> None:
    """If only one of them ended, the result is a step."""
    writer, slab = writer_of("next_step", (2, 3), ("ann", "bob"))
    begin(writer, {})
    assert slab.is_reset[0].all()
    no = np.zeros((2, 3), bool)
    # No agent ends in sub-environment 0, one in 1, both in 2.
    step(writer, np.ones((2, 3)), np.array([[0, 1, 1], [0, 0, 1]], bool), no, {})
    assert not slab.is_reset[0].any()
    step(writer, np.ones((2, 3)), no, no, {})
    assert slab.is_reset[0].tolist() == [[False, False, True]] * 2


@pytest.mark.parametrize(
    ("mode", "lengths", "returns", "over"),
    [
        ("disabled", [0, 0], [1, 2], [True, True]),
        ("next_step", [1, 0], [1, 0], [False, False]),
        ("same_step", [1, 1], [1, 1], [False, True]),
    ],
)
def test_who_waits_keeps_its_return_and_who_resets_itself_begins_anew(
    mode: Autoreset, lengths: list[int], returns: list[int], over: list[bool]
) -> None:
    """A reset in the next step ends nothing, whatever its flags say."""
    writer, slab = writer_of(mode, (2,))
    no = np.zeros(2, bool)
    step(writer, np.ones(2), ~no, no, {})
    begin(writer, {})
    for ends in ([True, False], [True, True], [False, True]):
        step(writer, np.ones(2), np.array(ends), no, {})
    assert slab.episode_length[0].tolist() == lengths
    assert slab.episode_return[0].tolist() == returns
    assert slab.over[0].tolist() == over


# -- what has no place in the row


@pytest.mark.parametrize(
    ("head", "agents", "value"),
    [
        ((), (), np.array([2.0])),
        ((), (), np.float32(2)),
        ((3,), (), [2, 2, 2]),
        ((3,), (), np.full((3, 1), 2)),
        ((2,), ("a", "b"), {"b": 2, "a": 2.0}),
        ((2, 3), ("a", "b"), {"a": np.full(3, 2), "b": [2, 2, 2]}),
    ],
)
def test_rewards_of_any_container_get_the_shape_of_the_row(
    head: Any, agents: Any, value: Any
) -> None:
    """An extra axis of length one is dropped."""
    writer, slab = writer_of("disabled", head, agents)
    ends = dict.fromkeys(agents, False) if agents else False
    if head and not agents:
        ends = np.zeros(head, bool)
    if len(head) == 2:
        ends = {agent: np.zeros(head[1], bool) for agent in agents}
    step(writer, value, ends, ends, {})
    assert (slab.reward[0] == np.full(head, 2)).all()


@pytest.mark.parametrize("what", ["reward", "terminated", "truncated"])
def test_a_value_with_a_wrong_shape_is_named(what: str) -> None:
    """The error has both shapes."""
    writer, _ = writer_of("disabled", (3,))
    good = {"reward": np.zeros(3), "terminated": np.zeros(3, bool), "truncated": np.zeros(3, bool)}
    with pytest.raises(ValueError, match=rf"{what} of env 'e-0' has shape \(2,\), expected \(3,\)"):
        step(writer, *{**good, what: np.zeros(2)}.values(), {})
