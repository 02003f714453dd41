"""What runs on top of a group: each feature is used, and compared with what envs must have done."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from combinations.options import NUM_ENVS, SEED, Books, Use, assert_as_played
from combinations.played import Transition, as_tuple
from timelines import Seen

from rlightning_aio.collecting import Collector, Rollout
from rlightning_aio.collecting.rollout import Ends
from rlightning_aio.evaluation import evaluate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rlightning_aio.batch import BatchedData


def steps(use: Use, folder: Path) -> None:
    """All envs step together."""
    del folder
    step_all(use, 20).check(5)


def step_all(use: Use, count: int) -> Books:
    books = Books(use)
    with use.group.auto_reset(use.options.limit):
        batch, _ = use.done(use.group.reset(seed=SEED))
        books.take(batch)
        for _ in range(count):
            batch, _ = use.done(use.group.step(batch.respond(action=use.act(batch))))
            books.take(batch)
    return books


def first_come(use: Use, folder: Path) -> None:
    """Whoever is ready is asked again."""
    del folder
    collect(use, 25).check(2)


def collect(use: Use, count: int) -> Books:
    books = Books(use)
    least, most = use.options.results
    with use.group.auto_reset(use.options.limit):
        use.group.reset_async(seed=SEED)
        for turn in itertools.count():
            batch, _ = use.done(use.group.collect_async(min_results=least, max_results=most))
            books.take(batch)
            # Who comes first is the machine's affair; that all have come in the end is not.
            if turn >= count and min(map(len, books.lists)) >= 2:
                break
            use.group.step_async(batch.respond(action=use.act(batch)))
    return books


# -- rollouts


def answer(use: Use) -> Callable[[BatchedData], dict[str, Any]]:
    """A policy that attaches the very columns that the batch has."""
    return lambda batch: {"action": use.act(batch), "seen": batch.observation}


def rollouts(
    use: Use, group: Any, between: Callable[[], object] = bool, **options: Any
) -> list[Rollout]:
    """Three of them, whose arrays are looked at when the next one has been collected."""
    kept: list[Rollout] = []
    with use.group.auto_reset(use.options.limit):
        collector: Any = Collector(group, answer(use), seed=SEED, **options)
        for _ in range(3):
            if kept:
                between()
            kept.append(use.done(collector.collect()))
            if len(kept) > 1:
                kept[-2] = copied(kept[-2])
        kept[-1] = copied(kept[-1])
    return kept


def copied(rollout: Rollout) -> Rollout:
    """One whose arrays nobody else writes to."""
    columns = {name: rollout[name].copy() for name in rollout}
    ends = Ends(rollout.ends, rollout.end_observation.copy())
    return Rollout(columns, ends, rollout.episodes)


def stored(use: Use, found: list[Rollout]) -> list[list[Transition]]:
    """The transitions of rollouts, one list for each env."""
    lists: list[list[Transition]] = [[] for _ in range(use.size)]
    for rollout in found:
        np.testing.assert_array_equal(rollout.seen, rollout.observation)
        after = rollout.next_observation
        for place in np.ndindex(rollout.shape):
            lists[rollout.index[place]].append(
                Transition(
                    as_tuple(rollout.observation[place]),
                    as_tuple(rollout.action[place]),
                    float(rollout.reward[place]),
                    bool(rollout.terminated[place]),
                    bool(rollout.truncated[place]),
                    as_tuple(after[place]),
                    bool(rollout.first[place]),
                )
            )
    return lists


def chains(use: Use, folder: Path) -> None:
    """A collector stores what its policy saw, and each transition once."""
    del folder
    found = rollouts(use, use.group, num_transitions=17, min_results=use.options.results[0])
    assert [len(rollout) for rollout in found] == [17] * 3
    assert_as_played(use, stored(use, found))


def blocks(use: Use, folder: Path) -> None:
    """As many transitions of each env, where it can make them."""
    del folder
    if use.kind.width > 1 and use.kind.mode != "same_step":
        with pytest.raises(ValueError, match=r"no \[T, N\] block"):
            rollouts(use, use.group, num_transitions=5 * use.size, wait_all=True)
        return
    found = rollouts(use, use.group, num_transitions=5 * use.size, wait_all=True)
    assert [rollout.shape for rollout in found] == [(5, use.size)] * 3
    lists = stored(use, found)
    assert {len(own) for own in lists} == {15}
    assert_as_played(use, lists)


# -- the rest


def evaluation(use: Use, folder: Path | None = None, /, **options: Any) -> None:
    """As many episodes of each env, and what they must have given."""
    del folder
    least = use.options.results[0]
    with use.group.auto_reset(use.options.limit):
        found = use.done(evaluate(use.group, use.act, 3, seed=SEED, min_results=least, **options))
    rows = {(e.env_id, e.sub_env, e.index): (e.reward, e.length) for e in found.played}
    assert len(rows) == len(found.attempts)
    width = max(use.kind.width, 1)
    expected: dict[Any, Any] = {}
    for k, n in itertools.product(range(NUM_ENVS), range(3)):
        resets_itself = use.kind.mode != "disabled"
        seed = SEED + k * width + (0 if resets_itself else n * use.size)
        for sub_env, own in enumerate(use.played(seed, 200)):
            episodes = split(own)
            episode = episodes[n if resets_itself else 0]
            total = sum(transition.reward for transition in episode)
            expected[use.group.env_ids[k], sub_env, n] = total, len(episode)
    assert rows == expected


def split(transitions: list[Transition]) -> list[list[Transition]]:
    """Transitions, episode by episode."""
    found: list[list[Transition]] = []
    for transition in transitions:
        if transition.first:
            found.append([])
        found[-1].append(transition)
    return found


def timeline(use: Use, folder: Path) -> None:
    """A recording changes nothing, and has a slice for each result."""
    with use.group.trace(folder / "run.json"):
        books = collect(use, 12)
    books.check(2)
    assert len(Seen(folder / "run.json").results()) == books.num_results


def snapshots(use: Use, folder: Path) -> None:
    """Envs that are put back show where they stood, and do the same again."""
    del folder
    seen: list[list[Any]] = []
    with use.group.auto_reset(use.options.limit):
        batch, _ = use.done(use.group.reset(seed=SEED))
        for _ in range(3):
            batch, _ = use.done(use.group.step(batch.respond(action=use.act(batch))))
        stood = batch.observation.copy()
        kept = use.done(use.group.snapshot())
        for _ in range(2):
            seen.append([])
            for _ in range(9):
                batch, _ = use.done(use.group.step(batch.respond(action=use.act(batch))))
                columns = batch.observation, batch.reward, batch.done, batch.is_reset
                seen[-1].append([column.tolist() for column in columns])
            batch, _ = use.done(use.group.restore(kept))
            np.testing.assert_array_equal(batch.observation, stood)
    assert seen[0] == seen[1]


FEATURES = (
    steps,
    first_come,
    chains,
    blocks,
    evaluation,
    timeline,
    snapshots,
)
