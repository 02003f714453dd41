"""With ``on_env_error: restart``, an exception costs its env one episode, as a death does."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import gymnasium as gym
import numpy as np
import pytest
from kit.driven import Driven, on_one_driver
from kit.scripted import Awaitable, Counts
from kit.tokens import Tokens, entry, marked, two_workers

from rlightning_aio.errors import EnvHung, EnvRaised

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import rlightning_aio as rl

    Start: TypeAlias = Callable[..., Driven]

CAUSES = {
    "raise": "raised ValueError: as asked for",
    "odd constructor": "raised kit.faulty.OddConstructor: code 7 in step",
    "system exit": "raised SystemExit: 5",
}


def check_marked(batch: rl.BatchedData, env_id: str, cause: str, kind: str) -> None:
    """Check that one result of a batch, and no other, is marked as this."""
    for key, ret in batch.items():
        assert marked(ret) == (key == env_id)
    row = batch.ids().index(env_id)
    outcome = batch.outcome[row]
    assert batch.restarted.tolist() == [k == row for k in range(len(batch))]
    assert (outcome.kind, outcome.env_id, outcome.cause) == (kind, env_id, cause)
    info = batch.info()[row]
    assert (info["worker_restarted"], info["env_at_fault"]) == (cause, env_id)


def test_an_exception_in_a_step_ends_one_episode(start: Start) -> None:
    """The env is rebuilt, in the same process; all others have stepped."""
    group, tokens = start(two_workers(on_env_error="restart")), Tokens()
    pids = [ret.observation[1] for ret in group.reset()[0].values()]
    for number, (name, cause) in enumerate(CAUSES.items()):
        batch, _ = group.step(tokens.steps(group.group.env_ids, {"faulty-1": name}))
        check_marked(batch, "faulty-1", cause, "env_raised")
        others = [k for k, key in enumerate(batch.ids()) if key != "faulty-1"]
        tokens.check(batch.take(others))
        assert group.group.metrics()["envs/restarts"] == number + 1
        batch, _ = group.step(tokens.steps(group.group.env_ids))
        tokens.check(batch)
    assert [ret.observation[1] for ret in batch.values()] == pids


@on_one_driver
def test_an_exception_in_a_reset_begins_another_episode(start: Start) -> None:
    """With options, which go through the channel, and without; what came after it is lost."""
    group, tokens = start(two_workers(on_env_error="restart")), Tokens()
    cause = CAUSES["raise"]
    batch, _ = group.reset(options={"fault": "raise"}, env_ids=["faulty-1"])
    check_marked(batch, "faulty-1", cause, "not_started")
    group.call("faulty-1", "arm", "resetting", "raise")
    batch, _ = group.reset(seed=3)
    check_marked(batch, "faulty-1", cause, "not_started")
    tokens.check(group.step(tokens.steps(group.group.env_ids))[0])


@pytest.mark.parametrize("place", ["resetting", "building"])
def test_exceptions_in_a_row_are_raised_at_last(start: Start, tmp_path: Path, place: str) -> None:
    """The env stays usable: its next step begins an episode that says what has happened."""
    switch = tmp_path / "broken"
    kwargs = {"faults": {place: "raise"}, "only": 1, "while_exists": str(switch)}
    fields: dict[str, Any] = {"on_env_error": "restart", "max_restarts": 2}
    group, tokens = start(two_workers(env_kwargs=kwargs, **fields)), Tokens()
    env_ids = group.group.env_ids
    switch.touch()
    with pytest.raises(EnvRaised, match="as asked for") as caught:
        group.step(tokens.steps(env_ids, {"faulty-1": "raise"}))
    assert caught.value.__notes__[0] == (
        "2 restarts in a row (max_restarts) came before it; the next request tries again"
    )
    assert (caught.value.outcome.kind, caught.value.results.ids()) == (
        "env_raised", ["faulty-0", "faulty-2", "faulty-3"],
    )  # fmt: skip
    with pytest.raises(EnvRaised, match="as asked for"):
        group.step(tokens.steps(env_ids))
    switch.unlink()
    batch, _ = group.step(tokens.steps(env_ids))
    check_marked(batch, "faulty-1", CAUSES["raise"], "env_raised")
    tokens.check(group.step(tokens.steps(env_ids))[0])
    batch, _ = group.step(tokens.steps(env_ids, {"faulty-1": "raise"}))
    check_marked(batch, "faulty-1", CAUSES["raise"], "env_raised")
    assert group.group.metrics()["envs/restarts"] == 3


class Lives(Counts):
    """Its observation is its number among all that were made, and its steps; action 1 raises,
    and so does action 2, as Ctrl-C does.

    Attributes:
        made: how many were made in this process; closed: of them, the numbers of those closed.
    """

    observation_space = gym.spaces.Box(0, np.inf, (2,), np.float64)
    length = 4
    made: ClassVar[int] = 0
    closed: ClassVar[list[int]] = []

    def __init__(self) -> None:
        Lives.made += 1
        self.number = Lives.made

    def does(self, action: Any) -> None:
        if action:
            raise KeyError("a bug") if action == 1 else KeyboardInterrupt

    def observed(self) -> Any:
        return np.array([self.number, self.steps], np.float64)

    def told(self) -> dict[str, Any]:
        return {} if self.steps else {"told": self.options.get("task", "nothing")}

    def lives(self) -> tuple[int, list[int]]:
        return Lives.made, Lives.closed

    def close(self) -> None:
        Lives.closed.append(self.number)


class AwaitedLives(Awaitable):
    """The same with coroutines."""

    def __init__(self) -> None:
        super().__init__(Lives)


@pytest.mark.parametrize(
    ("driver", "place"),
    [
        ("sync", {"task": Lives, "placement": "inline", "num_workers": 1}),
        ("sync", {"task": Lives, "placement": "inline", "num_workers": 3}),
        ("uvloop", {"task": Lives, "placement": "inline", "num_workers": 3}),
        ("sync", {"task": Lives, "envs_per_process": 3, "num_workers": 3}),
        ("sync", {"task": AwaitedLives, "envs_per_process": 3, "num_workers": 3}),
        ("uvloop", {"task": AwaitedLives, "placement": "loop", "num_workers": 3}),
    ],
)
def test_the_env_is_closed_and_rebuilt_wherever_it_lives(
    build: Start, place: dict[str, Any]
) -> None:
    """An awaitable env, which has the options of its episode, begins that episode again."""
    Lives.made, Lives.closed = 0, []
    group = build({"name": "e", "on_env_error": "restart", **place})
    group.init()
    batch, _ = group.reset(options={"task": "a task"})
    batch, _ = group.step(batch.respond(action=np.zeros(len(batch), int)))
    first = batch.observation[:, 0].tolist()
    for fault in (1, 2):
        actions = np.zeros(len(batch), int)
        actions[-1] = 1
        batch, _ = group.step(batch.respond(action=actions))
        assert batch.restarted.tolist() == [False] * (len(batch) - 1) + [True]
        assert batch.outcome[-1].cause == "raised KeyError: 'a bug'"
        assert batch.observation[-1].tolist() == [first[-1] + fault, 0]
        awaits = place["task"] is AwaitedLives
        assert batch.info()[-1]["told"] == ("a task" if awaits else "nothing")
        assert batch.observation[:-1, 0].tolist() == first[:-1]
        batch, _ = group.step(batch.respond(action=np.zeros(len(batch), int)))
        assert batch.observation[-1].tolist() == [first[-1] + fault, 1]
    made, closed = group.call("e-0", "lives")
    assert (made, closed) == (len(batch) + 2, [first[-1], first[-1] + 1])


class Unsendable(Lives):
    """Action 1 returns what can't leave its process."""

    def step(self, action: Any) -> Any:
        return *super().step(0)[:-1], {"lock": threading.Lock()} if action else {}


class AwaitedUnsendable(Awaitable):
    def __init__(self) -> None:
        super().__init__(Unsendable)


@pytest.mark.parametrize("task", [Unsendable, AwaitedUnsendable])
@on_one_driver
def test_an_env_whose_result_cannot_be_sent_is_rebuilt(build: Start, task: type) -> None:
    """Its worker raises that in its place."""
    group = build({"name": "e", "task": task, "placement": "process", "on_env_error": "restart"})
    group.init()
    batch, _ = group.reset()
    batch, _ = group.step(batch.respond(action=[1]))
    assert batch.restarted.tolist() == [True]
    assert "can't be pickled" in batch.outcome[0].cause
    assert batch.observation.tolist() == [[2, 0]]


class HangsToo(AwaitedLives):
    """Action 3 hangs."""

    async def pause(self, action: Any = None) -> None:
        if action == 3:
            await asyncio.Event().wait()


@pytest.mark.parametrize("placement", ["process", "loop"])
@pytest.mark.parametrize("driver", ["uvloop"])
def test_exceptions_and_hangs_are_counted_together(build: Start, placement: str) -> None:
    """So many losses in a row, without a completed step in between."""
    limits = {"on_env_error": "restart", "max_restarts": 1, "step_timeout": 0.5}
    group = build({"name": "e", "task": HangsToo, "placement": placement, **limits})
    group.init()
    batch, _ = group.reset()
    batch, _ = group.step(batch.respond(action=[1]))
    assert batch.restarted.tolist() == [True]
    with pytest.raises(EnvHung, match="1 restarts in a row"):
        group.step(batch.respond(action=[3]))
    batch, _ = group.step(batch.respond(action=[0]))
    assert batch.restarted.tolist() == [True]


@pytest.mark.parametrize("task", [Lives, AwaitedLives])
@on_one_driver
def test_an_env_is_not_rebuilt_after_ctrl_c(build: Start, task: type) -> None:
    """That is no error of the env, so it goes on with the episode."""
    Lives.made = 0
    group = build({"name": "e", "task": task, "placement": "process", "on_env_error": "restart"})
    group.init()
    batch, _ = group.reset(seed=1)
    with pytest.raises(EnvRaised, match="KeyboardInterrupt"):
        group.step(batch.respond(action=np.array([2])))
    assert group.call("e-0", "lives") == (1, [])
    batch, _ = group.step(batch.respond(action=np.array([0])))
    assert batch.observation.tolist() == [[1, 1]]


@on_one_driver
def test_the_log_has_the_traceback(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    """Of the first three."""
    group, tokens = start(entry(2, on_env_error="restart")), Tokens()
    for _ in range(5):
        group.step(tokens.steps(group.group.env_ids, {"faulty-1": "raise"}))
        group.step(tokens.steps(group.group.env_ids))
    texts = [record.getMessage() for record in caplog.records]
    assert len(texts) == 3
    for text in texts:
        assert "env 'faulty-1' (entry 'faulty'" in text
        assert "raised in step: ValueError: as asked for; restart 1 of 3 in a row" in text
        assert "faulty.py" in text
    assert "restart 3 of entry 'faulty', of which every 100th is logged\n" in texts[-1]
