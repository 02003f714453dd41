"""`Staging`: assembles transitions, in the order of their beginnings.

A step request takes a *place*, a row of the columns that holds the observation and the policy's
answer; the result completes it. If the result ends no transition (a reset, an episode lost with
its worker), the env's next step uses the place. So each transition is stored once, in any order of
results. Incomplete places of a full rollout are carried over to the next one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from rlightning_aio.batch.data import has_ended
from rlightning_aio.collecting.trees import allocated, check_alike, grown, scattered
from rlightning_aio.protocol.columns import gather
from rlightning_aio.trees import mapped

if TYPE_CHECKING:
    from collections.abc import KeysView, Mapping, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.collecting.results import Ended, ResultRows
    from rlightning_aio.protocol.columns import Rows
    from rlightning_aio.trees import Tree

_OF_PLACES: Final = ("index", "first", "policy_version")
"""Columns with the env of each place, the begin of a chain, and the version of the policy."""
_NO_PLACE: Final = -1
_NO_ROWS: Final = np.zeros(0, np.intp)


class Full(NamedTuple):
    """The order of the transitions of a rollout.

    Attributes:
        order: ``[n]``, their places, those of each env contiguous and in order.
        ends: ``[k]``, positions in `order` of transitions without successor, ends of chains first.
        end_rows: ``[k]``, rows of `Staging.end_observation`.
    """

    order: NDArray[np.intp]
    ends: NDArray[np.intp]
    end_rows: NDArray[np.intp]


class Staging:
    """Places for the transitions of one rollout, and for steps in flight.

    Args:
        quota: maximum number of transitions of a rollout.
        infos: names of numbers in infos that become columns.

    Attributes:
        columns: trees of ``[places, …]`` by name; allocated with the first rows.
        complete: number of complete transitions.
        made: number of complete transitions by env.
        episodes: those that ended with these transitions.
    """

    def __init__(self, quota: int, infos: Sequence[str]) -> None:
        self._quota = quota
        self._infos = infos
        self.episodes: list[Ended] = []
        self.columns: dict[str, Tree] = {}
        self.complete = 0
        self.end_observation: Tree = None
        # Names of the columns that a policy's request has, fixed once any were sent.
        self._given: KeysView[str] = {}.keys()
        self._is_settled = False
        # True once a transition was completed; the columns of resets may be incomplete.
        self._knows_results = False
        # How many places there are, and how many are complete or in flight. `_make_room` adds one
        # for each env.
        self._size, self._used = quota, 0
        # By env: the place of its step in flight, and of its last transition; True if the next one
        # begins a chain; True if its episode is over and waits for a reset.
        self.made = np.zeros(0, np.int64)
        self._place = np.zeros(0, np.intp)
        self._last = np.zeros(0, np.intp)
        self._fresh = np.zeros(0, np.bool_)
        self._over = np.zeros(0, np.bool_)
        self._known = np.zeros(0, np.bool_)
        self._resets_in_same_step = np.zeros(0, np.bool_)
        # The place of each end; the observation after it is in the same row of `end_observation`.
        self._end_place = np.zeros(quota, np.intp)
        self._num_ends = self._end_room = 0

    # -- envs -------------------------------------------------------------------------

    def newcomers(self, index: NDArray[np.int64]) -> NDArray[np.intp]:
        """Return positions in `index` of envs that are new, and make room for them."""
        try:
            if False not in self._known[index].tolist():
                return _NO_ROWS
        except IndexError:
            self._make_room(index)
        new = (~self._known[index]).nonzero()[0]
        self._known[index[new]] = True
        return new

    def _make_room(self, index: NDArray[np.int64]) -> None:
        known = len(self._place)
        count = max(int(index.max()) + 1, 2 * known)
        self._size = size = self._quota + count
        self._end_place = grown(self._end_place, size)
        self.columns = {name: grown(column, size) for name, column in self.columns.items()}
        self.made = grown(self.made, count)
        for name in ("_place", "_last", "_fresh", "_over", "_known", "_resets_in_same_step"):
            setattr(self, name, grown(getattr(self, name), count))
        self._place[known:] = self._last[known:] = _NO_PLACE
        self._fresh[known:] = True

    def note_same_step(self, envs: Any) -> None:
        """Record that these envs begin their next episode in the step that ends one."""
        self._resets_in_same_step[envs] = True

    def over(self, index: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Mask of the envs that wait for a reset."""
        return self._over[index]

    # -- steps ------------------------------------------------------------------------

    def check(self, given: Mapping[str, Tree]) -> None:
        """Check that the columns of a request match those of earlier requests.

        Raises:
            ValueError: names or shapes differ.
        """
        if not self._is_settled:
            return
        if given.keys() != self._given:
            now, before = sorted(given), sorted(self._given)
            raise ValueError(
                f"the policy's answer makes the columns {', '.join(now)}, and before there were "
                f"{', '.join(before)}; a policy must give the same ones each time"
            )
        check_alike(self.columns, given)

    def begin(self, index: NDArray[np.int64], given: Mapping[str, Tree], version: int) -> None:
        """Store a request to the envs of `index` (``[n]``): checked columns ``[n, …]``.

        The observation is one of them; `version` is that of the policy. If the request can't be
        sent, the next one to these envs overwrites it.
        """
        ours = (index, self._fresh[index], np.full(len(index), version, np.int64))
        given = {**given, **dict(zip(_OF_PLACES, ours, strict=True))}
        if not self._is_settled:
            for name in self._given:
                del self.columns[name]
            self._given = dict.fromkeys(name for name in given if name not in _OF_PLACES).keys()
            self.columns |= allocated(given, self._size)
        places = self._place[index]
        new = places < 0
        count = len(new.nonzero()[0])
        rows: Any = slice(self._used, self._used + count)
        if count == len(index):
            places = np.arange(self._used, self._used + count)
        else:
            places[new] = np.arange(self._used, self._used + count)
            rows = places
        scattered(self.columns, rows, given)
        self._used += count
        self._place[index] = places

    def note_sent(self) -> None:
        """Require all further requests to have the columns of the last one."""
        self._is_settled = True

    def store(self, results: ResultRows, rows: NDArray[np.intp], room: int) -> NDArray[np.intp]:
        """Complete at most `room` of the transitions that end in `rows` of results.

        Returns:
            The remaining rows: transitions of the next rollout.
        """
        if not self._knows_results:
            self._adopt_results(results)
        all_rows = len(rows) == len(results.index)
        index = results.index if all_rows else results.index[rows]
        resets = results.is_reset if all_rows else results.is_reset[rows]
        ending = self._place[index] >= 0
        if len(resets.nonzero()[0]):
            self._begin_chains(index[resets], ending[resets])
            # A restored env may be at the end of its episode, and wait for a reset.
            over = has_ended(results.batch).reshape(-1)[rows] & resets
            self._over[index] |= over & ~self._resets_in_same_step[index]
            ending &= ~resets
        ending &= ~self._over[index]
        chosen = ending.nonzero()[0]
        if len(chosen) == len(results.index) <= room:
            self._complete(results, index, slice(None))
            return rows[:0]
        if len(chosen):
            self._complete(results, index[chosen[:room]], rows[chosen[:room]])
        return rows[chosen[room:]]

    def _begin_chains(self, index: NDArray[np.int64], in_flight: NDArray[np.bool_]) -> None:
        """Record that envs begin an episode; a step in flight means that the last one was lost."""
        lost = index[in_flight & ~self._fresh[index] & (self._last[index] >= 0)]
        if len(lost):
            before = gather(self.columns["observation"], self._place[lost])
            self._note_ends(self._last[lost], before)
        self._fresh[index] = True
        self._over[index] = False

    def _complete(self, results: ResultRows, index: NDArray[np.int64], rows: Rows) -> None:
        self._knows_results = True
        places = self._place[index]
        for name, values in results.outcome.items():
            if type(values) is np.ndarray:
                self.columns[name][places] = values[rows]
            else:
                scattered(self.columns[name], places, mapped(lambda leaf: leaf[rows], values))
        for name in self._infos:
            scattered(self.columns[name], places, results.info(name)[rows])
        self._last[index] = places
        self._place[index] = _NO_PLACE
        self.made[index] += 1
        self.complete += len(index)
        done = results.done[rows]
        self._fresh[index] = done
        where = done.nonzero()[0]
        if len(where):
            ended = index[where]
            self._over[ended] = ~self._resets_in_same_step[ended]
            ended_rows = where if isinstance(rows, slice) else rows[where]
            self.episodes += results.episodes(ended_rows)
            places = places[where]
            self._note_ends(places, self._final(results, ended_rows, ended, places))

    def _final(
        self,
        results: ResultRows,
        rows: NDArray[np.intp],
        index: NDArray[np.int64],
        places: NDArray[np.intp],
    ) -> Tree:
        """Final observations of episodes that end in `rows`."""
        final = gather(results.observation, rows)
        same_step = self._resets_in_same_step[index].nonzero()[0]
        if len(same_step):
            # Where only the group's limit has cut the episode, the env has not reset itself.
            limit = results.batch.limit_reached.reshape(-1)[rows]
            otherwise = gather(self.columns["observation"], places[same_step])
            cut = np.flatnonzero(limit[same_step])
            scattered(otherwise, cut, gather(final, same_step[cut]))
            scattered(final, same_step, results.final_observation(rows[same_step], otherwise))
        return final

    def _adopt_results(self, results: ResultRows) -> None:
        self.columns |= allocated(results.outcome, self._size)
        single = mapped(lambda leaf: leaf.astype(np.float32), self.columns["reward"])
        self.columns["reward"] = single
        for name in self._infos:
            self.columns[name] = np.zeros(self._size)

    def _note_ends(self, places: NDArray[np.intp], observation: Tree) -> None:
        first, after = self._num_ends, self._num_ends + len(places)
        if self.end_observation is None:
            self._end_room = max(len(self._place), after)
            self.end_observation = allocated(observation, self._end_room)
        elif after > self._end_room:
            self.end_observation = grown(self.end_observation, 2 * after)
            self._end_room = 2 * after
        self._end_place[first:after] = places
        scattered(self.end_observation, slice(first, after), observation)
        self._num_ends = after

    # -- a rollout --------------------------------------------------------------------

    def full(self, held: ResultRows | None) -> Full:
        """Order the complete transitions; call `carry_over` afterwards.

        Args:
            held: rows of envs that have no step in flight.
        """
        self._end_chains(held)
        is_complete = np.ones(self._used, np.bool_)
        is_complete[self._place[self._place >= 0]] = False
        places, of_places = is_complete.nonzero()[0], self.columns["index"]
        order = places[of_places[places].argsort(kind="stable")]
        envs = of_places[order]
        position = np.empty(self._used, np.intp)
        position[order] = np.arange(len(order))
        ends = position[self._end_place[: self._num_ends]]
        inner = np.zeros(len(order), np.bool_)
        inner[:-1] = envs[1:] == envs[:-1]
        end_rows = np.lexsort((ends, inner[ends]))
        return Full(order, ends[end_rows], end_rows)

    def _end_chains(self, held: ResultRows | None) -> None:
        """Record the observation after each chain that continues in the next rollout."""
        continuing = ((self._last >= 0) & ~self._fresh).nonzero()[0]
        places = self._place[continuing]
        in_flight = continuing[places >= 0]
        if len(in_flight):
            before = gather(self.columns["observation"], self._place[in_flight])
            self._note_ends(self._last[in_flight], before)
        idle = continuing[places < 0]
        if len(idle):
            assert held is not None
            row = np.zeros(len(self._place), np.intp)
            row[held.index] = np.arange(len(held.index))
            self._note_ends(self._last[idle], gather(held.observation, row[idle]))

    def carry_over(self) -> None:
        """Drop complete transitions, and move steps in flight to the first places."""
        in_flight = (self._place >= 0).nonzero()[0]
        places = self._place[in_flight]
        now = slice(0, len(in_flight))
        for name in (*self._given, *_OF_PLACES):
            column = self.columns[name]
            scattered(column, now, gather(column, places))
        self._place[in_flight] = np.arange(len(in_flight))
        self._last[:] = _NO_PLACE
        self.made[:] = 0
        self._used = len(in_flight)
        self._num_ends = self.complete = 0
        self.episodes = []
