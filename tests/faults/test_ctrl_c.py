"""Ctrl-C at any moment of a call of a synchronous group: the group goes on afterwards."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from faults.striking import hear_of_interrupt, interrupt, press, struck
from kit.scripted import Counts
from patience import HANG

import rlightning_aio.sync
from rlightning_aio.errors import EnvBusy, EnvFault, GroupClosed
from rlightning_aio.protocol import kernel
from rlightning_aio.vector import VectorEnv

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rlightning_aio.batch import BatchedData

ENTRY = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1"}
PLACES = {
    "alone": {"placement": "inline"},
    "inline": {"placement": "inline", "num_workers": 3},
    "workers": {"num_workers": 3, "envs_per_process": 2},
}
pytestmark = pytest.mark.usefixtures("python_raises")
NUM_LINES = 3000
"""More lines than any of the calls below executes."""


def drop_outstanding(group: Any) -> None:
    """Wait until nothing is in flight, and drop it."""
    with contextlib.suppress(EnvFault):
        group.drain(deadline=HANG)


def step(group: Any, batch: BatchedData) -> None:
    group.step(batch.respond(action=np.ones(len(batch), int)))


def step_async(group: Any, batch: BatchedData) -> None:
    group.step_async(batch.respond(action=np.ones(len(batch), int)))
    group.collect_async(wait_all=True)


def reset(group: Any, batch: BatchedData) -> None:
    del batch
    group.reset(seed=4)


def call(group: Any, batch: BatchedData) -> None:
    del batch
    group.call("call_wrapped", "get_wrapper_attr", "render_mode")


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("use", [step, step_async, reset, call], ids=lambda use: use.__name__)
def test_a_group_goes_on_wherever_a_call_was_interrupted(
    use: Callable[[Any, BatchedData], None], place: str
) -> None:
    """The next reset and step give what they give without the interrupt."""
    alone = gym.make("CartPole-v1")
    with rlightning_aio.sync.build_env_group({**ENTRY, **PLACES[place]}) as group:
        count = len(group.env_ids)
        expected = np.array([alone.reset(seed=7 + k)[0] for k in range(count)])
        batch, _ = group.reset(seed=7)
        for line in range(1, NUM_LINES, 23):
            reached, interrupted, _ = struck(line, lambda last=batch: use(group, last))
            if reached and not interrupted:
                hear_of_interrupt(group.collect_async)
            drop_outstanding(group)
            batch, _ = group.reset(seed=7)
            np.testing.assert_array_equal(batch.observation, expected)
            batch, _ = group.step(batch.respond(action=np.zeros(count, int)))
            assert batch.reward.tolist() == [1.0] * count
            if not reached:
                break
        else:
            pytest.fail(f"a call executes more than {NUM_LINES} lines")
    alone.close()


def test_a_result_that_comes_with_ctrl_c_while_the_group_is_looked_at_is_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`get_workers` reads results, too: the one that it reads is collected later."""
    complete = kernel.complete

    def pressing(*args: Any) -> Any:
        slots = complete(*args)
        if slots is not None and len(slots):
            press()
        return slots

    with rlightning_aio.sync.build_env_group({**ENTRY, "num_workers": 2}) as group:
        batch, _ = group.reset(seed=0)
        group.step_async(batch.respond(action=np.ones(2, int)))
        monkeypatch.setattr(kernel, "complete", pressing)
        while any(worker["owed"] for worker in group.get_workers()):
            pass
        assert len(group.pending) == 2  # It only looks, too.
        hear_of_interrupt(group.collect_async)
        monkeypatch.setattr(kernel, "complete", complete)
        batch, _ = group.collect_async(wait_all=True, deadline=HANG)
        assert len(batch) == 2


# A step executes some 500 lines; these are a sample, and the last ones come after its end.
@pytest.mark.parametrize("line", range(1, 800, 113))
def test_a_group_can_be_closed_wherever_a_second_ctrl_c_interrupts_its_step(line: int) -> None:
    """The interrupt reaches the program unchanged; the fixtures check that no worker is left."""
    entry = {**ENTRY, "num_workers": 2, "envs_per_process": 1}
    with rlightning_aio.sync.build_env_group(entry) as group:
        batch, _ = group.reset(seed=0)
        reached, interrupted, _ = struck(line, lambda: step(group, batch), interrupt)
        assert interrupted == reached


class Pressing(Counts):
    """Presses Ctrl-C in each step."""

    def does(self, action: Any) -> None:
        press()


def test_a_program_that_handles_ctrl_c_itself_goes_on_doing_so() -> None:
    """Its handler is called at once, and is there afterwards; without one, nothing is left."""
    heard: list[int] = []
    before = signal.getsignal(signal.SIGINT)
    entry = {"name": "a", "task": Pressing, "placement": "inline"}
    with rlightning_aio.sync.build_env_group(entry) as group:
        batch, _ = group.reset()
        assert signal.getsignal(signal.SIGINT) is before
        own = signal.signal(signal.SIGINT, lambda number, _: heard.append(number))
        try:
            batch, _ = group.step(batch.respond(action=np.ones(1, int)))
        finally:
            assert signal.signal(signal.SIGINT, own) is not before
        assert heard == [signal.SIGINT]
        assert batch.observation.tolist() == [[1]]


class Saved(Counts):
    """Presses Ctrl-C when the state of the first of its kind is saved."""

    presses: Iterator[Callable[[], None]]

    def save_state(self) -> Any:
        next(self.presses, int)()

    def load_state(self, state: Any) -> None: ...


@pytest.mark.parametrize("use", ["step", "step_async", "reset", "call"])
def test_an_interrupted_call_of_all_inline_envs_keeps_none_of_them_busy(use: str) -> None:
    """What is left of it is executed before the next request."""
    Saved.presses = iter([press])
    entry = {"name": "a", "task": Saved, "placement": "inline", "num_workers": 4}
    with rlightning_aio.sync.build_env_group(entry) as group:
        batch, _ = group.reset()
        with pytest.raises(KeyboardInterrupt):
            group.snapshot()
        uses_of(group, batch)[use]()


def uses_of(group: Any, batch: BatchedData) -> dict[str, Callable[[], Any]]:
    return {
        "step": lambda: group.step(batch.respond(action=[0] * len(batch))),
        "step_async": lambda: group.step_async(batch.respond(action=[0] * len(batch))),
        "reset": group.reset,
        "call": lambda: group["a-0"].get_attr("observation_space"),
    }


class Waiting(Counts):
    """Presses Ctrl-C in the trainer, and waits for a file."""

    waits_for: Any = None

    def wait(self, trainer: int, go_on: str) -> None:
        os.kill(trainer, signal.SIGINT)
        while not os.path.exists(go_on):  # noqa: PTH110  # In a worker.
            time.sleep(0.001)

    def save_state(self) -> Any:
        if self.waits_for is not None:
            self.wait(*self.waits_for)
        return 0

    def load_state(self, state: Any) -> None:
        self.save_state()


@pytest.mark.parametrize("use", ["step", "step_async", "reset", "call"])
@pytest.mark.parametrize("interrupted", ["call", "snapshot"])
def test_an_env_is_free_again_after_a_call_that_was_interrupted(
    use: str, interrupted: str, tmp_path: Path
) -> None:
    """Once the call has ended, though nobody waits for it."""
    go_on = tmp_path / "go-on"
    waits_for = os.getpid(), str(go_on)
    entry = {"name": "a", "task": Waiting}
    with rlightning_aio.sync.build_env_group(entry) as group:
        batch, _ = group.reset()
        env = group["a-0"]
        env.set_attr("waits_for", waits_for)
        uses = uses_of(group, batch)
        with pytest.raises(KeyboardInterrupt):
            env.call("wait", *waits_for) if interrupted == "call" else group.snapshot()
        with pytest.raises(EnvBusy, match="what was cancelled or aborted still runs in it"):
            uses[use]()
        assert group.pending == []
        go_on.touch()
        until = time.monotonic() + HANG
        while True:
            try:
                uses[use]()
            except EnvBusy:
                assert time.monotonic() < until
            else:
                break


@pytest.mark.parametrize("interrupted", ["snapshot", "restore"])
def test_a_vector_env_waits_for_the_rest_of_a_call_that_was_interrupted(
    interrupted: str, tmp_path: Path
) -> None:
    """Its users know nothing of requests."""
    go_on = tmp_path / "go-on"
    env = VectorEnv([Waiting])
    env.reset()
    state = env.snapshot()
    env.set_attr("waits_for", [(os.getpid(), str(go_on))])
    with pytest.raises(KeyboardInterrupt):
        env.snapshot() if interrupted == "snapshot" else env.restore(state)
    timer = threading.Timer(0.1, go_on.touch)
    timer.start()
    env.reset()
    env.step([1])
    timer.join()
    env.close()


def test_an_interrupt_names_the_env_that_was_waited_for() -> None:
    """And `close` then names the env that hangs."""
    entry = {"name": "a", "task": Waiting, "num_workers": 3, "envs_per_process": 3}
    group = rlightning_aio.sync.build_env_group(entry)
    group.init()
    group.reset()
    with pytest.raises(KeyboardInterrupt) as caught:
        group["a-1"].call("wait", os.getpid(), "/never")
    (note,) = caught.value.__notes__
    assert re.fullmatch(r"no reply yet from a-1 \(for \d\.\d s\)", note)
    with pytest.warns(UserWarning, match="did not close in time and was killed; a-1 owed a reply"):
        group.close()


def test_an_interrupted_start_names_the_envs_that_have_not_started() -> None:
    entry = {"name": "a", "task": Starting, "num_workers": 10, "envs_per_process": 10}
    group = rlightning_aio.sync.build_env_group(entry)
    with pytest.raises(KeyboardInterrupt) as caught:
        group.init()
    names = ", ".join(f"a-{k}" for k in range(8))
    assert caught.value.__notes__ == [f"not started yet: {names} and 2 more"]


def trainer_of_worker() -> int:
    """Return the parent of this worker's fork server."""
    return int(Path(f"/proc/{os.getppid()}/stat").read_text().rpartition(")")[2].split()[1])


class Starting(Waiting):
    """Presses Ctrl-C in the trainer while it is made, and goes on making itself."""

    def __init__(self) -> None:
        self.wait(trainer_of_worker(), "/never")


class Closing(Waiting):
    """Presses Ctrl-C in the trainer while it is closed, and goes on closing."""

    def close(self) -> None:
        self.wait(trainer_of_worker(), "/never")


def test_an_interrupted_close_does_all_that_a_close_does(tmp_path: Path) -> None:
    """A timeline that was begun is written."""
    group = rlightning_aio.sync.build_env_group({"name": "a", "task": Closing})
    group.init()
    group.trace(tmp_path / "timeline.json").start()
    with pytest.raises(KeyboardInterrupt):
        group.close()
    assert (tmp_path / "timeline.json").exists()
    group.close()


def test_an_interrupt_after_the_last_result_is_raised_when_the_group_is_closed() -> None:
    """Not before."""
    entry = {**ENTRY, **PLACES["workers"]}
    group = rlightning_aio.sync.build_env_group(entry)
    group.init()
    interrupted, line = True, 2
    while interrupted:  # At last, Ctrl-C comes too late for the reset to raise it.
        drop_outstanding(group)
        _, interrupted, _ = struck(line, group.reset)
        line += 20
    with pytest.raises(KeyboardInterrupt):
        group.close()
    with pytest.raises(GroupClosed):
        group.reset()
