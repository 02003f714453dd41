"""Each failure is a typed outcome: what happened, and who can have caused it."""

from __future__ import annotations

import json
import math
import pickle
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pytest
from kit.scripted import BLAME, CUT, DIE, END, GO, HANG, RAISE, Awaited, Scripted

import rlightning_aio as rl
from rlightning_aio.outcomes import TimeSpent

if TYPE_CHECKING:
    from collections.abc import Callable

    from kit.driven import Driven

    Start: TypeAlias = Callable[..., Driven]


def entry(**fields: Any) -> dict[str, Any]:
    limits = {"step_timeout": 0.4, "reset_timeout": 0.4}
    place = {} if fields.get("placement") == "loop" else {"envs_per_process": 2}
    return {"name": "f", "task": Scripted, "num_workers": 2, **place, **limits, **fields}


def actions_of(group: Driven, *actions: int) -> rl.BatchedData:
    ids = group.group.env_ids
    return rl.BatchedData(ids, [rl.PolicyResponse(i, a) for i, a in zip(ids, actions, strict=True)])


def step(group: Driven, *actions: int) -> rl.BatchedData:
    return group.step(actions_of(group, *actions))[0]


def said(outcome: Any) -> tuple[str, str, str]:
    return outcome.kind, outcome.blame, outcome.env_id


def test_ends_of_their_own_are_the_policys(start: Start) -> None:
    """A step limit as well; a row in the middle of an episode has no outcome."""
    group = start(entry())
    with group.group.auto_reset(2):
        assert step(group, GO, END).outcome.tolist()[0] is None
        found = step(group, GO, END).outcome
        assert said(found[0]) == ("truncated", "policy", "f-0")
        assert "limit" in found[0].cause
        assert found[1] is None  # Its reset.
        found = step(group, GO, CUT)
        assert said(found.outcome[1]) == ("truncated", "policy", "f-1")
        assert not found.outcome[1].is_failure


@pytest.mark.parametrize(
    ("deed", "kind", "blame"), [(DIE, "env_died", "env"), (HANG, "env_hung", "either")]
)
def test_a_lost_episode_says_so_and_blames_no_neighbour(
    start: Start, deed: int, kind: str, blame: str
) -> None:
    """The result of the next reset carries it, in a column and in its info."""
    group = start(entry())
    group.step_async(actions_of(group, deed, GO))
    found: dict[str, Any] = {}
    while len(found) < 2:
        batch = group.collect_async()[0]
        found.update(zip(batch.env_ids(), batch.outcome, strict=True))
        infos = zip(batch.outcome, batch.info(), strict=True)
        assert all(outcome == info.get("outcome") for outcome, info in infos)
    assert said(found["f-0"]) == (kind, blame, "f-0")
    if found["f-1"] is None:  # It had replied before.
        found["f-1"] = step(group, GO, GO).outcome[1]
    assert said(found["f-1"]) == ("env_died", "infrastructure", "f-1")
    assert "f-0" in found["f-1"].cause


def test_a_reset_that_hangs_is_not_the_policys(start: Start) -> None:
    group = start(entry(num_workers=1, on_worker_death="raise"))
    with pytest.raises(rl.EnvHung) as caught:
        group.reset(options={"deed": HANG})
    assert said(caught.value.outcome) == ("env_hung", "env", "f-0")


@pytest.mark.parametrize("driver", ["uvloop"], indirect=True)
@pytest.mark.parametrize("placement", ["loop", "process"])
def test_awaitable_envs_say_the_same(start: Start, placement: str) -> None:
    group = start(entry(task=Awaited, num_workers=1, placement=placement))
    assert said(step(group, HANG).outcome[0]) == ("env_hung", "either", "f-0")
    with pytest.raises(rl.EnvRaised) as caught:
        step(group, BLAME)
    assert said(caught.value.outcome) == ("env_raised", "policy", "f-0")
    with pytest.raises(rl.EnvRaised) as caught:
        group.reset(options={"deed": RAISE})
    assert said(caught.value.outcome) == ("not_started", "env", "f-0")


def test_sub_environments_have_outcomes_of_their_own(start: Start) -> None:
    group = start({"name": "c", "task": "CartPole-v1", "num_workers": 1, "num_envs": 3})
    actions = np.ones((1, 3), np.int64)
    batch = group.reset(seed=0)[0]
    for _ in range(200):
        batch = group.step(batch.respond(action=actions))[0]
        assert batch.outcome.shape == (1, 3)
        done = batch.done[0]
        assert [outcome is not None for outcome in batch.outcome[0]] == done.tolist()
        if done.any():
            break
    ended = batch.outcome[0, int(done.argmax())]
    assert said(ended) == ("terminated", "policy", "c-0")


def test_it_survives_json_and_pickle() -> None:
    outcome = rl.Outcome("timed_out", "either", "90 s were over", "f-0", 2, TimeSpent(1.5, 2.0, 0))
    assert rl.Outcome.from_json(json.loads(json.dumps(outcome.to_json()))) == outcome
    assert pickle.loads(pickle.dumps(outcome)) == outcome
    assert outcome.is_failure
    for wrong in ({"kind": "lost"}, {"blame": "you"}, {"more": math.pi}):
        with pytest.raises((ValueError, TypeError)):
            rl.Outcome.from_json({**outcome.to_json(), **wrong})


class Particular(Scripted):
    """Can't be reset without options, as a replacement does."""

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return super().reset(seed=seed, options={"deed": options["deed"]})


def test_a_replacement_that_raises_hides_no_death(build: Any) -> None:
    """The episode has ended by the death, not by the reset that was to tell of it."""
    group = build(entry(task=Particular, num_workers=1))
    group.init()
    group.reset(options={"deed": GO})
    with pytest.raises(rl.EnvRaised, match="its worker or env exited with code 3") as caught:
        step(group, DIE)
    assert said(caught.value.outcome) == ("env_died", "env", "f-0")
