"""Ctrl-C at any moment of a call of a synchronous group: the group goes on afterwards."""

from __future__ import annotations

import os
import signal
import sys
import time
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from patience import HANG

import rlightning_aio.sync
from rlightning_aio.errors import EnvBusy
from rlightning_aio.vector.leftovers import drop_outstanding

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path
    from types import FrameType

    from rlightning_aio.batch import BatchedData

ENTRY = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1"}
PLACES = {
    "alone": {"placement": "inline"},
    "inline": {"placement": "inline", "num_workers": 3},
    "workers": {"num_workers": 3, "envs_per_process": 2},
}
NUM_LINES = 3000
"""More lines than any of the calls below executes."""


@pytest.fixture(autouse=True)
def python_raises() -> Iterator[None]:
    """Have Ctrl-C raise KeyboardInterrupt, also where the shell has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def press() -> None:
    """Press Ctrl-C."""
    signal.raise_signal(signal.SIGINT)


def interrupt() -> None:
    """Raise what a second Ctrl-C raises at once, also where the first one is held back."""
    raise KeyboardInterrupt


class Strike:
    """A trace function that calls `strike` at the n-th line of this library."""

    def __init__(self, line: int, strike: Callable[[], None]) -> None:
        self.left = line
        self.strike = strike

    def __call__(self, frame: FrameType, event: str, arg: Any) -> Any:
        return self._line if "/rlightning_aio/" in frame.f_code.co_filename else None

    def _line(self, frame: FrameType, event: str, arg: Any) -> Any:
        if event == "line":
            self.left -= 1
            if self.left == 0:
                self.strike()
        return self._line


def struck(line: int, call: Callable[[], object], how: Callable[[], None] = press) -> bool:
    """Make a call with Ctrl-C at that line; return True if the line was reached."""
    strike, interrupted = Strike(line, how), False
    sys.settrace(strike)
    try:
        call()
    except KeyboardInterrupt:
        interrupted = True
    finally:
        sys.settrace(None)
    assert interrupted == (strike.left <= 0)
    return interrupted


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
    group.call_async("call_wrapped", "get_wrapper_attr", "render_mode")
    group.collect_calls()


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
            reached = struck(line, lambda last=batch: use(group, last))
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


# A step executes some 500 lines; these are a sample, and the last ones come after its end.
@pytest.mark.parametrize("line", range(1, 800, 113))
def test_a_group_can_be_closed_wherever_a_second_ctrl_c_interrupts_its_step(line: int) -> None:
    """The interrupt reaches the program unchanged; the fixtures check that no worker is left."""
    entry = {**ENTRY, "num_workers": 2, "envs_per_process": 1}
    with rlightning_aio.sync.build_env_group(entry) as group:
        batch, _ = group.reset(seed=0)
        struck(line, lambda: step(group, batch), interrupt)


class Pressing(gym.Env[Any, Any]):
    """Presses Ctrl-C in each step."""

    observation_space = gym.spaces.Discrete(2)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return 0, {}

    def step(self, action: Any) -> Any:
        press()
        return 1, 1.0, False, False, {}


def test_a_program_that_handles_ctrl_c_itself_goes_on_doing_so() -> None:
    """Its handler is called at once, and is there afterwards; without one, nothing is left."""
    heard: list[int] = []
    before = signal.getsignal(signal.SIGINT)
    entry = {"name": "a", "make_env": Pressing, "placement": "inline"}
    with rlightning_aio.sync.build_env_group(entry) as group:
        batch, _ = group.reset()
        assert signal.getsignal(signal.SIGINT) is before
        own = signal.signal(signal.SIGINT, lambda number, _: heard.append(number))
        try:
            batch, _ = group.step(batch.respond(action=np.ones(1, int)))
        finally:
            assert signal.signal(signal.SIGINT, own) is not before
        assert heard == [signal.SIGINT]
        assert batch.observation.tolist() == [1]


class Saved(Pressing):
    """Presses Ctrl-C when the state of the first of its kind is saved."""

    presses: Iterator[Callable[[], None]]

    def step(self, action: Any) -> Any:
        return 1, 1.0, False, False, {}

    def save_state(self) -> Any:
        next(self.presses, int)()

    def load_state(self, state: Any) -> None: ...


@pytest.mark.parametrize("use", ["step", "step_async", "reset", "call"])
def test_an_interrupted_call_of_all_inline_envs_keeps_none_of_them_busy(use: str) -> None:
    """What is left of it is executed before the next request."""
    Saved.presses = iter([press])
    entry = {"name": "a", "make_env": Saved, "placement": "inline", "num_workers": 4}
    with rlightning_aio.sync.build_env_group(entry) as group:
        batch, _ = group.reset()
        with pytest.raises(KeyboardInterrupt):
            group.snapshot()
        uses_of(group, batch)[use]()


def uses_of(group: Any, batch: BatchedData) -> dict[str, Callable[[], Any]]:
    return {
        "step": lambda: group.step(batch.respond(action=[1] * len(batch))),
        "step_async": lambda: group.step_async(batch.respond(action=[1] * len(batch))),
        "reset": group.reset,
        "call": lambda: group["a-0"].get_attr("observation_space"),
    }


class Waiting(Pressing):
    """Presses Ctrl-C in the trainer, and waits for a file."""

    def step(self, action: Any) -> Any:
        return 1, 1.0, False, False, {}

    def wait(self, trainer: int, go_on: str) -> None:
        os.kill(trainer, signal.SIGINT)
        while not os.path.exists(go_on):  # noqa: PTH110  # In a worker.
            time.sleep(0.001)

    def save_state(self) -> Any:
        self.wait(*self.waits_for)
        return 0

    def load_state(self, state: Any) -> None: ...


@pytest.mark.parametrize("use", ["step", "step_async", "reset", "call"])
@pytest.mark.parametrize("interrupted", ["call", "snapshot"])
def test_an_env_is_free_again_after_a_call_that_was_interrupted(
    use: str, interrupted: str, tmp_path: Path
) -> None:
    """Once the call has ended, though nobody waits for it."""
    go_on = tmp_path / "go-on"
    waits_for = os.getpid(), str(go_on)
    entry = {"name": "a", "make_env": Waiting}
    with rlightning_aio.sync.build_env_group(entry) as group:
        batch, _ = group.reset()
        env = group["a-0"]
        env.set_attr("waits_for", waits_for)
        uses = uses_of(group, batch)
        with pytest.raises(KeyboardInterrupt):
            env.call("wait", *waits_for) if interrupted == "call" else group.snapshot()
        with pytest.raises(EnvBusy, match="a call that was cancelled still runs in it"):
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
