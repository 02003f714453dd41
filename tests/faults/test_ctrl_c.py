"""Ctrl-C at any moment of a call: it reaches the program, and a synchronous group goes on."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pytest
from faults.striking import press, struck
from kit.scripted import Awaitable, Counts
from patience import HANG

import rlightning_aio.sync
from rlightning_aio.errors import EnvRaised
from rlightning_aio.protocol import kernel

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio.batch import BatchedData

ENTRY = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1"}
PLACES: dict[str, dict[str, Any]] = {
    "inline": {"placement": "inline", "num_workers": 3},
    "workers": {"num_workers": 3, "envs_per_process": 2},
}
pytestmark = pytest.mark.usefixtures("python_raises")
STRIDE = int(os.environ.get("RLIGHTNING_AIO_STRIDE", "37"))
"""Every so many lines, Ctrl-C is pressed; 1 takes minutes."""
NUM_LINES = 4000
"""More lines than any of the calls below executes."""


class Serial(Counts):
    """Numbers what it is asked for, beginning with 1."""

    serial = 0

    def observed(self) -> Any:
        self.serial += 1
        return np.array([float(self.serial)])


class Answers:
    """Checks that each request of each env has one answer."""

    def __init__(self, group: Any) -> None:
        self.group = group
        self.last = dict.fromkeys(group.env_ids, 0)

    def take(self, batch: BatchedData) -> BatchedData:
        for env_id, serial in zip(batch.ids(), batch.observation[:, 0].tolist(), strict=True):
            assert serial == self.last[env_id] + 1, f"{env_id} has answered unheard"
            self.last[env_id] = serial
        return batch

    def take_outstanding(self) -> None:
        while self.group.pending:
            try:
                self.take(self.group.collect_async()[0])
            except EnvRaised as fault:  # Ctrl-C came before it counted, or after.
                if fault.exception_type != "KeyboardInterrupt":
                    raise
                self.look(fault.env_id)

    def look(self, env_id: str) -> None:
        self.last[env_id] = self.group[env_id].get_attr("serial")


def step(group: Any, batch: BatchedData) -> Any:
    return group.step(batch.respond(action=np.ones(len(batch), int)))


def step_async(group: Any, batch: BatchedData) -> Any:
    group.step_async(batch.respond(action=np.ones(len(batch), int)))
    return group.collect_async(wait_all=True)


def reset(group: Any, batch: BatchedData) -> Any:
    del batch
    return group.reset(seed=4)


def snapshot(group: Any, batch: BatchedData) -> None:
    del batch
    group.snapshot()


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("use", [step, step_async, reset, snapshot], ids=lambda use: use.__name__)
def test_a_group_is_whole_wherever_ctrl_c_comes(
    use: Callable[[Any, BatchedData], Any], place: str, pressed_again: list[bool]
) -> None:
    """It is raised, and what was in flight is collected; or the call ends, and it comes again."""
    with rlightning_aio.sync.build_env_group({"task": Serial, **PLACES[place]}) as group:
        answers = Answers(group)
        batch = answers.take(group.reset()[0])
        for _ in range(12):  # Until steps are ordinary.
            answers.take(step(group, batch)[0])
        num_raised = 0
        for number, line in enumerate(range(1, NUM_LINES, STRIDE)):
            reached, interrupted, returned = struck(line, lambda: use(group, batch))
            assert len(pressed_again) == (reached and not interrupted)
            pressed_again.clear()
            num_raised += interrupted
            if returned is not None:
                answers.take(returned[0])
            if number % 3 and use is not snapshot:  # It may still run in an env.
                answers.take_outstanding()
            else:
                first, _ = group.reset()
                assert len(first) == len(batch)
                assert first.is_reset.all()
                for env_id in group.env_ids:
                    answers.look(env_id)
            answers.take(step(group, batch)[0])
            if not reached:
                break
        else:
            pytest.fail(f"a call executes more than {NUM_LINES} lines")
        assert num_raised > 0


def test_ctrl_c_that_comes_while_a_call_moves_data_comes_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The call returns its results, and a long update of the learner after it is interrupted."""
    gather = kernel.gather

    def pressing(*args: Any) -> Any:
        press()
        return gather(*args)

    with rlightning_aio.sync.build_env_group({**ENTRY, "num_workers": 2}) as group:
        group.reset(seed=0)
        with monkeypatch.context() as patch:
            patch.setattr(kernel, "gather", pressing)
            batch, _ = group.reset(seed=0)
        assert len(batch) == 2
        with pytest.raises(KeyboardInterrupt):
            time.sleep(HANG)
        assert len(step(group, batch)[0]) == 2


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


class Waiting(Counts):
    """Presses Ctrl-C in the trainer, and hangs."""

    def wait(self, trainer: int) -> None:
        os.kill(trainer, signal.SIGINT)
        time.sleep(3600)


def test_an_interrupt_names_the_env_that_was_waited_for() -> None:
    """And `close` then names the env that hangs."""
    entry = {"name": "a", "task": Waiting, "num_workers": 3, "envs_per_process": 3}
    group = rlightning_aio.sync.build_env_group(entry)
    group.init()
    group.reset()
    with pytest.raises(KeyboardInterrupt) as caught:
        group["a-1"].call("wait", os.getpid())
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
    assert caught.value.__context__ is None


def trainer_of_worker() -> int:
    """Return the parent of this worker's fork server."""
    return int(Path(f"/proc/{os.getppid()}/stat").read_text().rpartition(")")[2].split()[1])


class Starting(Waiting):
    """Presses Ctrl-C in the trainer while it is made, and is never done."""

    def __init__(self) -> None:
        self.wait(trainer_of_worker())


class ClosingHere(Counts):
    """Presses Ctrl-C while it is closed; the second one notes that it was closed."""

    closed: ClassVar[list[ClosingHere]] = []

    def close(self) -> None:
        self.closed.append(self)
        press()


def test_an_interrupted_close_of_inline_envs_closes_all_of_them() -> None:
    """Ctrl-C is raised in the code of each, and after that to the program."""
    entry = {"name": "a", "task": ClosingHere, "placement": "inline", "num_workers": 2}
    group = rlightning_aio.sync.build_env_group(entry)
    group.init()
    with (
        pytest.raises(KeyboardInterrupt),
        pytest.warns(UserWarning, match=r"close\(\) of env .*KeyboardInterrupt"),
    ):
        group.close()
    assert len(ClosingHere.closed) == 2


class Closing(Waiting):
    """Presses Ctrl-C in the trainer while it is closed, and is never done."""

    def close(self) -> None:
        self.wait(trainer_of_worker())


def test_an_interrupted_close_does_all_that_a_close_does(tmp_path: Path) -> None:
    """A timeline that was begun is written."""
    group = rlightning_aio.sync.build_env_group({"name": "a", "task": Closing})
    group.init()
    group.trace(tmp_path / "timeline.json").start()
    with pytest.raises(KeyboardInterrupt):
        group.close()
    assert (tmp_path / "timeline.json").exists()
    group.close()


class Struck(Awaitable):
    """Is interrupted in a step, or hangs there; the second one, in its making or its reset.

    Attributes:
        where: it is interrupted.
    """

    built: ClassVar[int] = 0
    where: ClassVar[str]

    def __init__(self) -> None:
        super().__init__(Counts)
        Struck.built += 1
        if Struck.built > 1 and self.where == "making":
            raise KeyboardInterrupt

    async def pause(self, action: Any = None) -> None:
        place = "reset" if action is None else "step"
        if place == self.where and (place == "step" or Struck.built > 1):
            raise KeyboardInterrupt
        if place == "step":
            await asyncio.Event().wait()


@pytest.mark.parametrize("where", ["step", "reset", "making"])
def test_an_interrupt_on_the_trainers_event_loop_reaches_the_program(where: str) -> None:
    """It may be the user's Ctrl-C, whatever an awaitable env executes then."""
    Struck.built, Struck.where = 0, where

    async def use() -> None:
        fields = {"name": "s", "task": Struck, "placement": "loop", "step_timeout": 0.1}
        async with rlightning_aio.build_env_group(fields) as group:
            batch, _ = await group.reset()
            await group.step(batch.respond(action=np.zeros(1, int)))

    with pytest.raises(KeyboardInterrupt):
        asyncio.run(use())
