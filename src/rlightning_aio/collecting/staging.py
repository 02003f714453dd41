"""`Staging`: where transitions come together, in the order in which they were begun.

An env that is asked to step takes a *place*, which holds what the policy saw and said; the
result completes it. A result that ends no transition (a reset, an episode lost with its worker)
leaves the place to the env's next step. So each transition is here once, whatever comes when;
places that are not complete when a rollout is full are carried over to the next one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.collecting.trees import allocated, check_alike, gathered, grown, scattered
from rlightning_aio.protocol.columns import gather, mapped

if TYPE_CHECKING:
    from collections.abc import KeysView, Mapping

    from numpy.typing import NDArray

    from rlightning_aio.collecting.results import Results
    from rlightning_aio.protocol.columns import Rows, Tree

__all__ = ["Full", "Staging"]

_NOWHERE: Final = -1
_NOBODY: Final = np.zeros(0, np.intp)
_OF_RESULTS: Final = ("reward", "terminated", "truncated")


class Full:
    """A rollout's transitions, still in their places.

    Attributes:
        order: ``[n]``, their places, each env's side by side and in order.
        ends: ``[k]``, positions in `order` after which nothing follows, those of chains first.
        end_rows: ``[k]``, rows of `Staging.end_observation`.
        num_chains: envs that have any.
    """

    __slots__ = ("end_rows", "ends", "num_chains", "order")

    def __init__(
        self,
        order: NDArray[np.intp],
        ends: NDArray[np.intp],
        end_rows: NDArray[np.intp],
        num_chains: int,
    ) -> None:
        self.order = order
        self.ends = ends
        self.end_rows = end_rows
        self.num_chains = num_chains


class Staging:
    """Places for the transitions of one rollout, and for what is in flight.

    Args:
        quota: transitions of a rollout, at most.
        num_envs: envs, sub-environments counted; there may come to be more.

    Attributes:
        columns: by name trees of ``[places, …]``; allocated when the first rows come.
        complete: how many transitions are.
        made: by env, how many of them are its own.
    """

    def __init__(self, quota: int, num_envs: int) -> None:
        self._quota = quota
        self.columns: dict[str, Tree] = {}
        self.complete = 0
        self.end_observation: Tree = None
        # Names of the columns that come with a request.
        self._given: KeysView[str] = {}.keys()
        # Whether a transition has ever been completed: resets may tell less than steps.
        self._knows_results = False
        # By place.
        size = quota + num_envs
        self._env = np.zeros(size, np.int64)
        self._first = np.zeros(size, np.bool_)
        self._version = np.zeros(size, np.int64)
        self._is_complete = np.zeros(size, np.bool_)
        self._used = 0
        # By env: the place of the step it owes, and of its last transition; whether the next one
        # begins a chain; whether its episode is over and waits for a reset.
        self.made = np.zeros(num_envs, np.int64)
        self._place = np.full(num_envs, _NOWHERE, np.intp)
        self._last = np.full(num_envs, _NOWHERE, np.intp)
        self._fresh = np.ones(num_envs, np.bool_)
        self._over = np.zeros(num_envs, np.bool_)
        self._known = np.zeros(num_envs, np.bool_)
        self._resets_itself_at_once = np.zeros(num_envs, np.bool_)
        # Of each end its place; its observation has the same row of `end_observation`.
        self._end_place = np.zeros(size, np.intp)
        self._num_ends = self._end_room = 0

    # -- envs -------------------------------------------------------------------------

    def newcomers(self, index: NDArray[np.int64]) -> NDArray[np.intp]:
        """Places in `index` of envs that were not here before; there is room for them then."""
        try:
            if self._known[index].all():
                return _NOBODY
        except IndexError:
            self._make_room(index)
        new = np.flatnonzero(~self._known[index])
        self._known[index[new]] = True
        return new

    def _make_room(self, index: NDArray[np.int64]) -> None:
        needed = int(index.max(initial=-1)) + 1
        known = len(self._place)
        if needed <= known:
            return
        count = max(needed, 2 * known)
        size = self._quota + count
        for name in ("_env", "_first", "_version", "_is_complete", "_end_place"):
            setattr(self, name, grown(getattr(self, name), size))
        self.columns = {name: grown(column, size) for name, column in self.columns.items()}
        self.made = grown(self.made, count)
        for name, value in (
            ("_place", _NOWHERE),
            ("_last", _NOWHERE),
            ("_fresh", True),
            ("_over", False),
            ("_known", False),
            ("_resets_itself_at_once", False),
        ):
            column = grown(getattr(self, name), count)
            column[known:] = value
            setattr(self, name, column)

    def note_same_step(self, envs: Any) -> None:
        """Envs that begin their next episode in the step that ends one."""
        self._resets_itself_at_once[envs] = True

    def over(self, index: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of these envs wait for a reset."""
        return self._over[index]

    # -- steps ------------------------------------------------------------------------

    def check(self, given: Mapping[str, Tree]) -> None:
        """Whether there is a column for what comes with a request.

        Raises:
            ValueError: other columns came before, or others in shape.
        """
        if not self._given:
            return
        if given.keys() != self._given:
            now, before = sorted(given), sorted(self._given)
            raise ValueError(
                f"the policy's answer makes the columns {', '.join(now)}, and before there were "
                f"{', '.join(before)}; a policy must give the same ones each time"
            )
        for name, values in given.items():
            check_alike(name, self.columns[name], values)

    def begin(self, index: NDArray[np.int64], given: Mapping[str, Tree], version: int) -> None:
        """Note what the envs of `index` (``[n]``) are asked: columns of ``[n, …]`` that were
        checked, the observation among them. `version` is the policy's.
        """
        if not self._given:
            self._given = dict.fromkeys(given).keys()
            for name, values in given.items():
                self.columns[name] = allocated(values, len(self._env))
        places = self._place[index]
        new = places < 0
        count = int(np.count_nonzero(new))
        rows: Any = slice(self._used, self._used + count)
        if count == len(index):
            places = np.arange(self._used, self._used + count)
        else:
            places[new] = np.arange(self._used, self._used + count)
            rows = places
        for name, values in given.items():
            scattered(self.columns[name], rows, values)
        self._used += count
        self._place[index] = places
        self._env[rows] = index
        self._first[rows] = self._fresh[index]
        self._version[rows] = version

    def store(self, results: Results, rows: NDArray[np.intp], room: int) -> NDArray[np.intp]:
        """Complete the transitions that end in `rows` of results, `room` at most.

        Returns:
            The rows that are left: transitions of the next rollout.
        """
        if not self._knows_results:
            self._adopt_results(results)
        all_rows = len(rows) == len(results.index)
        index = results.index if all_rows else results.index[rows]
        resets = results.is_reset if all_rows else results.is_reset[rows]
        ending = self._place[index] >= 0
        if np.count_nonzero(resets):
            self._begin_chains(index[resets], ending[resets])
            ending &= ~resets
        ending &= ~self._over[index]
        count = int(np.count_nonzero(ending))
        if count == len(results.index) <= room:
            self._complete(results, index, slice(None))
            return rows[:0]
        chosen = np.flatnonzero(ending)
        if count:
            self._complete(results, index[chosen[:room]], rows[chosen[:room]])
        return rows[chosen[room:]]

    def _begin_chains(self, index: NDArray[np.int64], owing: NDArray[np.bool_]) -> None:
        """Envs begin an episode; the one before may have been lost in the middle."""
        lost = index[owing & ~self._fresh[index] & (self._last[index] >= 0)]
        if len(lost):
            before = gather(self.columns["observation"], self._place[lost])
            self._note_ends(self._last[lost], before)
        self._fresh[index] = True
        self._over[index] = False

    def _complete(self, results: Results, index: NDArray[np.int64], rows: Rows) -> None:
        self._knows_results = True
        places = self._place[index]
        for name in _OF_RESULTS:
            values = getattr(results, name)
            if not isinstance(rows, slice):
                values = mapped(lambda leaf: leaf[rows], values)
            scattered(self.columns[name], places, values)
        self._is_complete[places] = True
        self._last[index] = places
        self._place[index] = _NOWHERE
        self.made[index] += 1
        self.complete += len(index)
        done = results.done[rows]
        self._fresh[index] = done
        if np.count_nonzero(done):
            ended = index[done]
            self._over[ended] = ~self._resets_itself_at_once[ended]
            ended_rows = np.flatnonzero(done) if isinstance(rows, slice) else rows[done]
            self._note_ends(places[done], self._final(results, ended_rows, ended, places[done]))

    def _final(
        self,
        results: Results,
        rows: NDArray[np.intp],
        index: NDArray[np.int64],
        places: NDArray[np.intp],
    ) -> Tree:
        """The final observations of episodes that end in `rows`."""
        final = gather(results.observation, rows)
        at_once = np.flatnonzero(self._resets_itself_at_once[index])
        if len(at_once):
            # Where the group's limit alone has cut the episode, nothing has begun anew.
            limit = results.batch.limit_reached.reshape(-1)[rows]
            otherwise = gather(self.columns["observation"], places[at_once])
            cut = np.flatnonzero(limit[at_once])
            scattered(otherwise, cut, gather(final, at_once[cut]))
            told = results.final_observation(rows[at_once], otherwise)
            scattered(final, at_once, told)
        return final

    def _adopt_results(self, results: Results) -> None:
        size = len(self._env)
        single = mapped(lambda leaf: leaf.astype(np.float32), results.reward)
        self.columns["reward"] = allocated(single, size)
        self.columns["terminated"] = allocated(results.terminated, size)
        self.columns["truncated"] = allocated(results.truncated, size)

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

    def full(self, held: Results | None) -> Full:
        """Arrange the transitions that are complete; to be followed by `carry_over`.

        Args:
            held: rows of envs that are to be asked next, which are in no place.
        """
        self._end_chains(held)
        places = np.flatnonzero(self._is_complete[: self._used])
        order = places[np.argsort(self._env[places], kind="stable")]
        envs = self._env[order]
        position = np.empty(self._used, np.intp)
        position[order] = np.arange(len(order))
        ends = position[self._end_place[: self._num_ends]]
        lasts = np.append(np.flatnonzero(np.diff(envs)), len(envs) - 1)[: len(envs)]
        inner = np.ones(len(order), np.bool_)
        inner[lasts] = False
        end_rows = np.lexsort((ends, inner[ends]))
        return Full(order, ends[end_rows], end_rows, len(lasts))

    def _end_chains(self, held: Results | None) -> None:
        """Note what comes after each chain that goes on in the next rollout."""
        going_on = np.flatnonzero((self._last >= 0) & ~self._fresh)
        places = self._place[going_on]
        in_flight = going_on[places >= 0]
        if len(in_flight):
            before = gather(self.columns["observation"], self._place[in_flight])
            self._note_ends(self._last[in_flight], before)
        resting = going_on[places < 0]
        if len(resting):
            assert held is not None
            row = np.zeros(len(self._place), np.intp)
            row[held.index] = np.arange(len(held.index))
            self._note_ends(self._last[resting], gather(held.observation, row[resting]))

    def read(self, name: str, order: NDArray[np.intp], out: Tree) -> None:
        """Copy a column, in `order`, to `out`."""
        gathered(self.columns[name], order, out)

    def of_places(self, order: NDArray[np.intp]) -> dict[str, NDArray[Any]]:
        """What is known of each place beside its columns: fresh arrays."""
        return {
            "policy_version": self._version[order],
            "index": self._env[order],
            "first": self._first[order],
        }

    def carry_over(self) -> None:
        """Forget what is complete; what is in flight begins the next rollout."""
        owing = np.flatnonzero(self._place >= 0)
        places = self._place[owing]
        now = slice(0, len(owing))
        for name, column in self.columns.items():
            if name not in _OF_RESULTS:
                scattered(column, now, gather(column, places))
        self._env[now] = owing
        self._first[now] = self._first[places]
        self._version[now] = self._version[places]
        self._place[owing] = np.arange(len(owing))
        self._is_complete[:] = False
        self._last[:] = _NOWHERE
        self.made[:] = 0
        self._used = len(owing)
        self._num_ends = self.complete = 0
