"""The functions of the hot path, in Python; `kernel` chooses between them and compiled ones.

Those that `kernel` names have a twin of the same contract in `_kernel.c`. `submit`, `complete` and
`gather` are the trainer's: they carry every ordinary step between arrays and the rings of all
workers. `serve` and `row_step` are the worker's. `arm` and `is_due` are the two sides of the bell
(`rings`).

Invariant: each shared word has one writer. A writer publishes (entry first, then the counter) and
fences before it reads what others write: whether the other side sleeps (`rings`), or the counters
of all workers. So of two workers that finish together, at least one sees the full sum. What another
process wrote is checked before it is used as a position, because that process may have failed in
the middle of anything.
Absent on purpose: decisions. The group checks requests and interprets results.
"""

from __future__ import annotations

import platform
import threading
import time
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from rlightning_aio.protocol.entries import (
    NUMBER_SHIFT,
    OP_BITS,
    OP_BITS_ARRAY,
    OP_MASK,
    SLOT_MASK,
    SLOT_MASK_ARRAY,
    WITHOUT_OP,
    Operation,
)
from rlightning_aio.protocol.info import NO_INFO, PICKLED

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

LINE: Final = 8
"""Words of a cache line."""
IN_ORDER: Final = platform.machine() in ("x86_64", "AMD64")
"""x86 keeps loads and stores in program order, except that a load may overtake an earlier store.
Elsewhere a count could become visible before its entry."""

# Words of a ring, each on its own cache line to avoid false sharing.
REQUESTS_SENT: Final = 0 * LINE
WORKER_ASLEEP: Final = 1 * LINE
FRAMES_TO_WORKER: Final = 2 * LINE
FRAMES_TO_TRAINER: Final = 3 * LINE
# The request that the worker executes, 0 if none, and since when. The time is written first: read
# after the request, it never makes that older than it is. The request is cleared before its report,
# so one whose reply the trainer has read doesn't look as if it were still executed.
CURRENT: Final = 4 * LINE
CURRENT_SINCE_NS: Final = 4 * LINE + 1
# The trainer's own counts: requests sent, and frames of the worker that were read.
SENT: Final = 0
SEEN: Final = 1
# The worker's own: requests taken, reports, frames read, the armed word that needs no ring by this
# worker (or no further one), and a flag: each request needs `execute`.
TAKEN: Final = 0
REPORTED: Final = 1
FRAMES_SEEN: Final = 2
SETTLED: Final = 3
CAREFUL: Final = 4
NUM_COUNTS: Final = 5

BUSY: Final = 1
"""The state of a slot whose request is in flight."""

# Words of the bell: the armed word, then the counters of the workers, each on its own line.
ARMED: Final = 0

# Bits of the armed word, from the lowest: 1; 1 if only workers without further work check it; the
# sum at which to ring; and an epoch that counts restarts of workers. 0 is disarmed.
AT_LAST: Final = 2
GOAL_SHIFT: Final = 2
GOAL_MASK: Final = (1 << 53) - 1

# Flags of a row; see `slab`.
_TERMINATED, _TRUNCATED, _IS_RESET, _OVER = range(4)

FEW_NUMBERS: Final = 8192
"""Up to this many numbers, BLAS multiplies in one thread."""

_STEP: Final = int(Operation.STEP)
_NEXT_STEP: Final = np.array((1 << NUMBER_SHIFT) + _STEP)


class Ring(NamedTuple):
    """The rings of one worker, as its trainer uses them.

    Attributes:
        words: shared counters and flags.
        requests, reports: shared, of a length that is a power of two.
        own: the trainer's own counts.
        wake: wakes the worker, if it sleeps.
    """

    words: memoryview[int]
    requests: NDArray[np.int64]
    reports: NDArray[np.int64]
    own: memoryview[int]
    wake: Callable[[], None]


class WorkerSide(NamedTuple):
    """The rings and the bell of one worker, as it uses them itself.

    Attributes:
        words: shared counters and flags.
        requests, reports: shared, both of the same length, a power of two.
        own: the worker's own counts.
        bell: shared; counter: position of this worker's counter there.
    """

    words: memoryview[int]
    requests: memoryview[int]
    reports: memoryview[int]
    own: memoryview[int]
    bell: memoryview[int]
    counter: int


class Row(NamedTuple):
    """The row of an env of one agent and one sub-environment, one buffer for each column.

    Attributes:
        reward, episode_return, episode_length, info_mark: of one element.
        flags: the four of `slab`.
        times: when the result was ready, and how long the env took, in ns.
        observation: an array; None if a row has several, or none.
    """

    reward: memoryview[float]
    flags: memoryview[bool]
    episode_return: memoryview[float]
    episode_length: memoryview[int]
    info_mark: memoryview[int]
    times: memoryview[int]
    observation: NDArray[Any] | None


def new_fence() -> Callable[[], None]:
    """A fence of one thread: it releases and retakes a held lock, which orders all memory
    accesses around it.

    On x86 both are locked instructions; on ARM a store-release followed by a
    load-acquire of the same word.
    """
    lock = threading.Lock()
    lock.acquire()
    release, acquire = lock.release, lock.acquire

    def fence() -> None:
        try:  # noqa: SIM105  # `suppress` would take longer than all the rest.
            release()
        except RuntimeError:
            pass  # A Ctrl-C had struck between the two.
        acquire()

    return fence


def submit(
    slots: NDArray[np.intp],
    resets: NDArray[np.bool_],
    now_ns: int,
    entry: NDArray[np.int64],
    state: NDArray[np.int8],
    sent_ns: NDArray[np.int64],
    host_of: NDArray[np.int64],
    in_flight: list[int],
    rings: Sequence[Ring | None],
    fence: Callable[[], None],
) -> list[Ring]:
    """Number and publish a step for each of `slots`, all idle; return rings of sleeping workers.

    Args:
        slots: of the envs, in the order of the batch.
        resets: ``[n]``, mask of those that are reset instead.
        now_ns: time of sending.
        entry: by slot; written, like the next two.
        state: by slot.
        sent_ns: by slot.
        host_of: by slot.
        in_flight: by host, counted up.
        rings: by host.
        fence: see `new_fence`.
    """
    entries = entry[slots]
    entries &= WITHOUT_OP
    entries += _NEXT_STEP
    entries += resets  # RESET == STEP + 1
    entry[slots] = entries
    state[slots] = BUSY
    sent_ns[slots] = now_ns
    hosts = host_of[slots]
    ends: list[int] = (hosts[1:] != hosts[:-1]).nonzero()[0].tolist()
    ends.append(len(hosts) - 1)
    published: list[Ring] = []
    start = 0
    for last in ends:
        host, end = hosts.item(last), last + 1
        ring = rings[host]
        assert ring is not None
        requests, own, sent = ring.requests, ring.own, ring.own[SENT]
        at = sent & (len(requests) - 1)
        split = min(end, start + len(requests) - at)
        requests[at : at + split - start] = entries[start:split]
        if split < end:
            requests[: end - split] = entries[split:end]
        if not IN_ORDER:
            fence()
        ring.words[REQUESTS_SENT] = own[SENT] = sent + end - start
        in_flight[host] += end - start
        published.append(ring)
        start = end
    fence()
    asleep: list[Ring] = []
    for ring in published:
        if ring.words[WORKER_ASLEEP]:
            asleep.append(ring)  # noqa: PERF401  # A comprehension is a call more.
    return asleep


def complete(
    counters: memoryview[int],
    read: memoryview[int],
    entry: NDArray[np.int64],
    in_flight: list[int],
    rings: Sequence[Ring | None],
    fence: Callable[[], None],
) -> NDArray[np.intp] | None:
    """Read the reports of all workers, and compare them with the current requests.

    Args:
        counters: shared, the number of reports of each worker.
        read: by worker, the number of reports that were read, followed by their sum; counted up.
        entry: by slot.
        in_flight: by host, counted down.
        rings: by host.
        fence: see `new_fence`.

    Returns the slots whose results are in their rows; or None, without reading anything, if a
    worker has also sent frames, which come first, or if a report answers no current request.
    """
    parts: list[NDArray[np.int64]] = []
    found: list[tuple[int, int, int]] = []
    total = 0
    counts = counters.tolist()
    if not IN_ORDER:
        fence()
    for host, count in enumerate(counts):
        before = read[host]
        if count == before:
            continue
        ring = rings[host]
        if ring is None or ring.words[FRAMES_TO_TRAINER] > ring.own[SEEN]:
            return None
        reports = ring.reports
        if not 0 < count - before <= len(reports):
            return None
        start = before & (len(reports) - 1)
        end = start + count - before
        parts.append(reports[start:end])
        if end > len(reports):
            parts.append(reports[: end - len(reports)])
        found.append((host, count, count - before))
        total += count - before
    if total > len(entry):
        return None
    entries = parts[0] if len(parts) == 1 else _joined(parts, total)
    slots = entries >> OP_BITS_ARRAY
    slots &= SLOT_MASK_ARRAY
    # A slot beyond the last one is compared with the last one's entry, which differs.
    if len((entry.take(slots, mode="clip") != entries).nonzero()[0]):
        return None
    for host, count, num_read in found:
        read[host] = count
        read[-1] += num_read
        in_flight[host] -= num_read
    return slots


def _joined(parts: list[NDArray[np.int64]], total: int) -> NDArray[np.int64]:
    entries = np.empty(total, np.int64)
    start = 0
    for part in parts:
        entries[start : start + len(part)] = part
        start += len(part)
    return entries


def gather(columns: Sequence[NDArray[Any]], rows: slice | NDArray[np.intp]) -> list[NDArray[Any]]:
    """Copy `rows` of each column."""
    found: list[NDArray[Any]] = []
    for column in columns:
        if type(rows) is slice:
            found.append(column[rows].copy())
        elif column.ndim == 1:  # For numbers, indexing is the fastest copy.
            found.append(column[rows])
        else:
            found.append(column.take(rows, axis=0))
    return found


def sum_of_squares(numbers: NDArray[Any]) -> float:
    """Return the sum of all squares: NaN, infinite or large if any number is."""
    return float(np.vdot(numbers, numbers))  # Unlike `dot`, it does not warn of an overflow.


# -- the bell -------------------------------------------------------------------------


def arm(bell: memoryview[int], armed: int, fence: Callable[[], None]) -> bool:
    """Write the armed word. Return True if the goal is reached, so no ring needs to be awaited.

    Args:
        bell: its words, shared.
        armed: the word; if it stands there already, no worker rings for it again.
        fence: see `new_fence`.
    """
    if bell[ARMED] != armed:
        bell[ARMED] = armed
        fence()
    return sum(bell[LINE::LINE]) >= (armed >> GOAL_SHIFT & GOAL_MASK)


def is_due(bell: memoryview[int], own: memoryview[int], fence: Callable[[], None]) -> bool:
    """Return True, once after each arming, if this worker must ring the trainer now.

    Args:
        bell: its words, shared.
        own: the worker's own counts.
        fence: see `new_fence`.
    """
    fence()
    armed = bell[ARMED]
    return armed != own[SETTLED] and _settle(bell, own, armed)


def _settle(bell: memoryview[int], own: memoryview[int], armed: int) -> bool:
    """Return True if the goal of the armed word is reached; this worker rings for it once."""
    if armed and sum(bell[LINE::LINE]) < (armed >> GOAL_SHIFT & GOAL_MASK):
        return False
    own[SETTLED] = armed
    return armed != 0


# -- the worker -----------------------------------------------------------------------


def take(side: WorkerSide, fence: Callable[[], None]) -> list[int]:
    """Take all waiting entries, in order.

    Raises:
        RuntimeError: the trainer's count is impossible.
    """
    own, ring = side.own, side.requests
    before = own[TAKEN]
    count = side.words[REQUESTS_SENT] - before
    if not count:
        return []
    if not 0 < count <= len(ring):
        raise RuntimeError(f"{count} requests in a ring for {len(ring)}")
    if not IN_ORDER:
        fence()
    start = before & (len(ring) - 1)
    own[TAKEN] = before + count
    split = min(count, len(ring) - start)
    return ring[start : start + split].tolist() + ring[: count - split].tolist()


def serve(  # noqa: C901  # Calls would slow down every step.
    side: WorkerSide,
    execute: Callable[[int], bool],
    finish: Callable[[int, object], object],
    ring: Callable[[], object],
    receive: Callable[[], object],
    steps: list[Callable[[], Any]],
    first_slot: int,
    fence: Callable[[], None],
) -> bool:
    """Take waiting entries, execute them in order and report them; False if there were none.

    Args:
        side: of the worker.
        execute: executes an entry that is no step, and any while the flag `CAREFUL` is set;
            returns True if it must be reported here.
        finish: replies to a step that raised (given the exception) or has parts out of band, and
            is called after any step that has set `CAREFUL`.
        ring: wakes the trainer; called when the group's bell is due.
        receive: reads frames; called before an entry if the channel has one.
        steps: steps each env; returns None if the row holds the whole result.
        first_slot: of `steps`.
        fence: see `new_fence`.
    """
    if not (requests := take(side, fence)):
        return False
    words, _, reports, own, bell, counter = side
    mask, clock = len(reports) - 1, time.monotonic_ns
    for request in requests:
        if words[FRAMES_TO_WORKER] > own[FRAMES_SEEN]:
            receive()
        words[CURRENT_SINCE_NS] = clock()
        if not IN_ORDER:
            fence()
        words[CURRENT] = request
        index = (request >> OP_BITS & SLOT_MASK) - first_slot
        if not own[CAREFUL] and request & OP_MASK == _STEP and 0 <= index < len(steps):
            try:
                outcome = steps[index]()
            except BaseException as error:  # noqa: BLE001  # It is the env's, and is sent.
                outcome = error
            if not (is_in_row := outcome is None and not own[CAREFUL]):
                finish(request, outcome)
        else:
            is_in_row = execute(request)
        words[CURRENT] = 0
        if not is_in_row:
            continue
        own[REPORTED] = sent = own[REPORTED] + 1
        reports[(sent - 1) & mask] = request
        if not IN_ORDER:
            fence()
        bell[counter] = sent
        fence()
        armed = bell[ARMED]
        if armed != own[SETTLED] and not armed & AT_LAST and _settle(bell, own, armed):
            ring()
    if is_due(bell, own, fence):
        ring()
    return True


def unpacked(result: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Return the five parts of the result of a step.

    Raises:
        TypeError, ValueError: it has no parts, or another number of them.
    """
    observation, reward, terminated, truncated, info = result
    return observation, reward, terminated, truncated, info


def row_step(
    row: Row,
    step: Callable[[Any], Any],
    get_input: Callable[[], Any],
    write_observation: Callable[[Any], None],
    number: Callable[[str, Any], float],
    write_info: Callable[[dict[str, Any]], int],
    keep: Callable[[dict[str, Any]], dict[str, Any]],
    resets_itself: bool,
) -> Callable[[], dict[str, Any] | None]:
    """Make a function that steps an env and writes the result into its row.

    The function returns the part of the result that is out of band. What it must know of the steps
    before is in the row.

    Args:
        row: of the env.
        step: of the env, as in Gymnasium.
        get_input: returns the input of a step.
        write_observation: writes an observation that isn't an array like the row's.
        number: converts a reward that isn't a number.
        write_info: writes an info that isn't empty; returns its mark.
        keep: returns the parts out of band, for the trainer to keep.
        resets_itself: the env begins the next episode in the step that ends one.
    """
    clock = time.monotonic_ns
    rewards, flags, returns, lengths, marks, times, observation_in_row = row
    in_row = np.empty(0) if observation_in_row is None else observation_in_row
    can_copy, shape, dtype = observation_in_row is not None, in_row.shape, in_row.dtype

    def execute() -> dict[str, Any] | None:
        began = clock()
        observation, reward, terminated, truncated, info = step(get_input())
        times[0] = done = clock()
        times[1] = done - began
        if (
            type(observation) is np.ndarray
            and observation.dtype is dtype
            and observation.shape == shape
            and can_copy
        ):
            in_row[...] = observation
        else:
            write_observation(observation)
        try:
            rewards[0] = reward
        except TypeError:
            rewards[0] = number("reward", reward)
        flags[_IS_RESET] = False
        was_over = flags[_OVER]
        if was_over and resets_itself:
            returns[0] = lengths[0] = 0
        returns[0] += rewards[0]
        lengths[0] += 1
        if was_over or terminated or truncated:
            _write_ends(row, bool(terminated), bool(truncated), was_over, resets_itself)
        marks[0] = mark = write_info(info) if info else NO_INFO
        return keep({"info": info}) if mark == PICKLED else None

    return execute


def _write_ends(
    row: Row, terminated: bool, truncated: bool, was_over: bool, resets_itself: bool
) -> None:
    """Write the flags of a step that ends an episode, or comes after an end."""
    row.flags[_TERMINATED], row.flags[_TRUNCATED] = terminated, truncated
    if was_over and not resets_itself:
        # A step after the end belongs to no episode; see `EpisodeSums`.
        row.episode_return[0] = row.episode_length[0] = 0
    row.flags[_OVER] = terminated or truncated or not resets_itself
