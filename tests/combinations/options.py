"""Options of a group, and a choice of them in which each pair of values comes together."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar

import numpy as np
from combinations.played import KINDS, TASKS, Transition, act, as_tuple, played
from kit.driven import Driven
from patience import HANG

from rlightning_aio.errors import NothingPending

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio.batch import BatchedData

SEED, NUM_ENVS = 7, 3
PLACEMENTS: dict[str, dict[str, Any]] = {
    "inline": {"placement": "inline"},
    "process": {"envs_per_process": 2},
    "ray": {"placement": "ray", "num_cpus": 0, "envs_per_process": 2, "start_timeout": HANG},
}
HERE = ("inline", "process")
"""Those that need no cluster."""
BOTH = "both"
"""Two envs in a worker, and one in this process, in an entry of its own."""
FACTORS: dict[str, tuple[Any, ...]] = {
    "kind": tuple(KINDS),
    "placement": (*HERE, BOTH),
    "zero_copy": (True, False),
    "task": tuple(TASKS),
    "limit": (math.inf, 4),
    "results": ((1, None), (2, 2), (2, None)),
    "is_async": (False, True),
}


@dataclass(frozen=True)
class Options:
    """What a group is built with, and how it is used.

    Attributes:
        results: `min_results` and `max_results` of a collect.
    """

    kind: str
    placement: str
    zero_copy: bool
    task: str
    limit: float
    results: tuple[int, int | None]
    is_async: bool

    def __str__(self) -> str:
        """An id for a test."""
        copies = "views" if self.zero_copy else "copies"
        limit = "" if self.limit == math.inf else f"-limit {self.limit}"
        least, most = self.results
        awaited = "-async" if self.is_async else ""
        words = f"{self.task}-{self.kind}-{self.placement}-{copies}-{least} to {most or 'all'}"
        return f"{words}{limit}{awaited}"

    @property
    def fits(self) -> bool:
        """CartPole warns of steps after its end."""
        return not (self.task == "CartPole" and self.kind == "three together")


class Choice(Protocol):
    """One value of each factor."""

    @property
    def fits(self) -> bool:
        """There can be such a group."""
        ...


C = TypeVar("C", bound=Choice)


def pairwise(make: Callable[..., C], factors: dict[str, tuple[Any, ...]]) -> list[C]:
    """Few choices among which every two values of different factors come together."""
    pairs = {
        choice: set(itertools.combinations(enumerate(values), 2))
        for values in itertools.product(*factors.values())
        if (choice := make(*values)).fits
    }
    missing = set[Any]().union(*pairs.values())
    chosen: list[C] = []
    while missing:
        chosen.append(max(pairs, key=lambda choice: len(pairs[choice] & missing)))
        missing -= pairs[chosen[-1]]
    return chosen


class Use(Driven):
    """A group with these options, initialised."""

    def __init__(self, options: Options) -> None:
        self.options, self.kind = options, KINDS[options.kind]
        task = partial(self.kind.make, options.task)
        placement = "process" if options.placement == BOTH else options.placement
        entry = {"name": "env", "task": task, "num_workers": NUM_ENVS, **PLACEMENTS[placement]}
        entries = [entry]
        if options.placement == BOTH:
            entry["num_workers"] = NUM_ENVS - 1
            entries.append({"name": "here", "task": task, **PLACEMENTS["inline"]})
        driver = "asyncio" if options.is_async else "sync"
        super().__init__(driver, entries, zero_copy=options.zero_copy)
        self.init()

    def drain(self) -> None:
        """Leave nothing outstanding."""
        while True:
            try:
                self.collect_async(wait_all=True)
            except NothingPending:
                return

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    @property
    def size(self) -> int:
        """Sub-environments of the group."""
        return NUM_ENVS * max(self.kind.width, 1)

    def act(self, batch: BatchedData) -> Any:
        """The policy's actions."""
        return act(self.options.task, batch.observation)

    def model(self, count: int) -> list[list[Transition]]:
        """`count` transitions at least of each env, after a reset with `SEED`."""
        return [
            own
            for k in range(NUM_ENVS)
            for own in self.played(SEED + k * max(self.kind.width, 1), count)
        ]

    def played(self, seed: int, count: int) -> list[list[Transition]]:
        """The same of one env, whose first reset has that seed."""
        seeds = range(seed, seed + max(self.kind.width, 1))
        return played(self.options.task, self.kind.mode, seeds, self.options.limit, count)


class Books:
    """One list for each env, of what a user stores who goes by the batch's own columns."""

    def __init__(self, use: Use) -> None:
        self._use = use
        self.lists: list[list[Transition]] = [[] for _ in range(use.size)]
        self.num_results = 0
        self._seen: dict[int, Any] = {}
        self._first: dict[int, bool] = {}
        self._waits: set[int] = set()

    def take(self, batch: BatchedData) -> None:
        """Store the transitions that end in `batch`."""
        self.num_results += len(batch)
        shape = batch.is_reset.shape
        columns = [
            np.reshape(column, (-1, *np.shape(column)[len(shape) :]))
            for column in (batch.observation, batch.reward, batch.terminated, batch.truncated)
        ]
        resets = batch.is_reset.reshape(-1)
        actions = None if resets.all() else np.reshape(batch.sent.action, (resets.size, -1))
        infos = batch.info()
        for row, index in enumerate(batch.index.reshape(-1).tolist()):
            observation, reward, terminated, truncated = (column[row] for column in columns)
            after = observation
            ended = bool(terminated or truncated)
            if ended and self._use.kind.mode == "same_step":
                env, sub_env = divmod(row, max(self._use.kind.width, 1))
                final = infos[env].get("final_obs")  # Not where the limit alone has cut it.
                if final is not None and self._use.kind.width > 1:
                    final = final[sub_env]
                after = observation if final is None else final
            if resets[row]:
                self._waits.discard(index)
                self._first[index] = True
            elif index not in self._waits:
                assert actions is not None
                self.lists[index].append(
                    Transition(
                        self._seen[index],
                        as_tuple(actions[row]),
                        float(reward),
                        bool(terminated),
                        bool(truncated),
                        as_tuple(after),
                        self._first[index],
                    )
                )
                self._first[index] = ended
                if ended and self._use.kind.mode == "disabled":
                    self._waits.add(index)
            self._seen[index] = as_tuple(observation)

    def check(self, at_least: int) -> None:
        """Compare them with what the envs must have done, `at_least` transitions each."""
        assert min(map(len, self.lists)) >= at_least
        assert_as_played(self._use, self.lists)


def assert_as_played(use: Use, lists: list[list[Transition]]) -> None:
    """Each list is the beginning of what its env must do."""
    model = use.model(max(map(len, lists)))
    for own, expected in zip(lists, model, strict=True):
        assert own == expected[: len(own)]
