"""Rules of the core that need an exact order of events, on hosts without processes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from unittest.mock import Mock

import pytest
from group.fake_host import PLAIN, FakeGroup

from rlightning_aio._core.group.engine.steps import CollectRules
from rlightning_aio._core.group.state.conditions import UNLIKE_ENVS
from rlightning_aio._core.hosts.messages import Lost
from rlightning_aio.batch import BatchedData
from rlightning_aio.errors import (
    NothingPending,
)
from rlightning_aio.outcomes import Loss
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from group.fake_host import Running

    NewGroup = Callable[..., FakeGroup]

pytestmark = pytest.mark.usefixtures("implementation")


@pytest.fixture
def new_group() -> Iterator[NewGroup]:
    groups: list[FakeGroup] = []

    def new_group(*rows: int, **kwargs: Any) -> FakeGroup:
        groups.append(FakeGroup(rows, **kwargs))
        return groups[-1]

    yield new_group
    while groups:
        groups.pop().close()


def steps(*slots: int, action: int = PLAIN) -> BatchedData:
    ids = [f"fake-{slot}" for slot in slots]
    return BatchedData(ids, [PolicyResponse(id_, action) for id_ in ids])


def collect(group: FakeGroup, **rules: Any) -> Running:
    return group.begin(group.steps.collect(group.now, CollectRules(**rules)))


def ids_of(running: Running) -> list[str]:
    return running.result()[0].ids()


def test_the_window_ends_for_results_that_joined_unnoticed(new_group: NewGroup) -> None:
    """After the window, a collect returns once it has the minimum."""
    group = new_group(8)
    group.steps.step_async(steps(*range(8)), group.now)
    running = collect(group, timeout=1.0, min_results=3)
    group.finish(0)
    group.pass_time(0.5)
    group.finish(1)
    group.finish(2)
    assert not running.done
    group.pass_time(0.5)
    assert ids_of(running) == ["fake-0", "fake-1", "fake-2"]


def test_the_window_opens_when_an_inline_result_is_there(new_group: NewGroup) -> None:
    """Not before the env was stepped, however long that takes."""
    group = new_group(1, 1, inline=[True, False])
    execute_one = group.hosts[0].execute_one

    def run_slowly() -> None:
        group.now += 2.0
        execute_one()

    group.hosts[0].execute_one = run_slowly
    group.steps.step_async(steps(0, 1), group.now)
    running = collect(group, timeout=1.0)
    group.pass_time(0.5)
    assert not running.done
    group.finish(1)
    assert sorted(ids_of(running)) == ["fake-0", "fake-1"]


@pytest.mark.parametrize("rules", [{"deadline": 1.5}, {"timeout": 1.5}])
def test_inline_envs_are_not_executed_past_a_deadline_or_a_window(
    new_group: NewGroup, rules: dict[str, float]
) -> None:
    """The wait ends after the current env; the others are left to the next call."""
    group = new_group(5, inline=[True])
    host = group.hosts[0]
    execute_one = host.execute_one

    def execute_slowly() -> None:
        group.now += 1.0
        execute_one()

    host.execute_one = execute_slowly
    group.steps.step_async(steps(*range(5)), group.now)
    running = collect(group, min_results=5 if "deadline" in rules else 1, **rules)
    if "deadline" in rules:
        with pytest.raises(TimeoutError, match="2 of the 5"):
            running.result()
    else:
        # The window opens when the first result is there.
        assert ids_of(running) == ["fake-0", "fake-1", "fake-2"]
    assert len(host.waiting) == (3 if "deadline" in rules else 2)
    collect(group, wait_all=True).result()
    assert not host.waiting


def test_empty_batches_do_nothing(new_group: NewGroup) -> None:
    """Only a collect of nothing is refused."""
    group = new_group(2)
    group.steps.step_async(BatchedData(), group.now)
    batch, flags = group.begin(group.steps.step(BatchedData(), group.now)).result()
    assert (len(batch), batch.values(), flags) == (0, [], None)
    batch, flags = group.begin(group.core.reset(group.now, 0, None, [])).result()
    assert (len(batch), flags) == (0, [])
    with pytest.raises(NothingPending):
        collect(group).result()


@pytest.mark.parametrize(
    "seed",
    [-1, [0, -1], {"fake-0": -1}, 1.5, [0.5, 1], True, "01", [None, 1], 2**63, {"fake-1": "x"}],
)
def test_a_bad_seed_is_refused_before_anything_is_sent(new_group: NewGroup, seed: Any) -> None:
    """Seeds are ints from 0 to 63 bits; the error has the value."""
    group = new_group(2)
    with pytest.raises(ValueError, match="seed"):
        group.begin(group.core.reset(group.now, seed, None, None)).result()
    assert not group.hosts[0].waiting


def test_seeds_are_counted_for_each_env(new_group: NewGroup) -> None:
    """A sequence has one seed for each env that is reset."""
    group = new_group(2)
    with pytest.raises(ValueError, match="3 seeds for 2 envs"):
        group.begin(group.core.reset(group.now, [1, 2, 3], None, None)).result()


def test_a_loss_that_is_read_before_the_last_answer_comes_after_it(new_group: NewGroup) -> None:
    """Answers travel in a ring, and losses in frames."""
    group = new_group(1)
    run(group, group.core.reset(group.now, None, None, None))
    why = Loss("ended while it was idle", "env_died", "env", "fake-0")
    for is_lost in (False, True):
        stepping = group.begin(group.steps.step(steps(0), group.now))
        entry = group.core.requests.numbering.entry.item(0)
        group.hosts[0].finish()
        group.core.tables.completions.append(Lost(0, 0, why, answered=entry))
        group.turn()
        batch, _ = stepping.result()
        assert batch.restarted.tolist() == batch.is_reset.tolist() == [is_lost]
        assert group.core.episodes.why_lost(0) == why
        assert group.core.supervisor.records[0].restarts == is_lost + 1


@pytest.mark.parametrize("ordinary", [True, False])
@pytest.mark.parametrize("ask", ["step", "step_async", "reset", "snapshot"])
def test_requests_that_were_sent_in_part_disturb_no_other_call(
    new_group: NewGroup, ask: str, ordinary: bool
) -> None:
    """Their results are left to the collector; the value of a call is dropped."""
    group = new_group(1, 1, 1)
    group.conditions.note(UNLIKE_ENVS, not ordinary)
    core = group.core
    batch, _ = run(group, core.reset(group.now, None, None, None))
    both = batch.take([0, 1]).respond(action=[PLAIN] * 2)
    ids = ["fake-0", "fake-1"]
    asked: dict[str, Callable[[], Any]] = {
        "step": lambda: group.begin(group.steps.step(both, group.now)).result(),
        "step_async": lambda: group.steps.step_async(both, group.now),
        "reset": lambda: group.begin(core.reset(group.now, None, None, ids)).result(),
        "snapshot": lambda: group.begin(core.snapshot(group.now, ids)).result(),
    }
    host: Any = group.hosts[1]
    with pytest.MonkeyPatch.context() as patch:
        broken = Mock(side_effect=OSError("no buffer space"))
        patch.setattr(host, "submit", broken)
        patch.setattr(host, "take_requests", broken)
        group.shared.rings[1] = host.rings.ring(broken)
        with pytest.raises(OSError, match="no buffer space"):
            asked[ask]()
    stepping = group.begin(group.steps.step(steps(2), group.now))
    group.finish(0)
    assert not stepping.done
    group.finish(2)
    assert ids_of(stepping) == ["fake-2"]
    if ask == "snapshot":
        group.steps.step_async(steps(0), group.now)
        group.finish(0)
    assert ids_of(collect(group)) == ["fake-0"]


def run(group: FakeGroup, procedure: Any) -> Any:
    """Run a procedure, and have its requests executed."""
    running = group.begin(procedure)
    while not running.done:
        host = next(host for host in group.hosts if host.waiting)
        group.finish(host.first_slot + host.waiting[0][0])
    return running.result()


def test_a_result_that_another_call_read_wakes_its_caller(new_group: NewGroup) -> None:
    """A collect of nothing reads every worker's reports; other calls still get their results."""
    group = new_group(2)
    resetting = group.begin(group.core.reset(group.now, 0, None, None))
    group.finish(0)
    with pytest.raises(NothingPending):
        collect(group).result()
    group.finish(1)
    assert ids_of(resetting) == ["fake-0", "fake-1"]


@pytest.mark.parametrize("whose", [0, 3])
def test_calls_go_on_when_one_is_cancelled(new_group: NewGroup, whose: int) -> None:
    group = new_group(4)
    callers = [group.begin(group.steps.step(steps(slot), group.now)) for slot in range(4)]
    group.cancel(callers[whose])
    for slot in range(4):
        group.finish(slot)
        assert slot == whose or ids_of(callers[slot]) == [f"fake-{slot}"]
    assert ids_of(collect(group)) == [f"fake-{whose}"]
