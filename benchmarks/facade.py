"""One env without work in one worker: what does the synchronous facade add to its core?

The same core is driven by `sync.EnvGroup.step` and by a minimal loop: poll, read, resume.
"""

from __future__ import annotations

import select
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import no_work
from contenders import Stepped, Work, group_config, sampled
from harness import Question, Target, main
from round_trip import SyncCalls, median_us

if TYPE_CHECKING:
    from rlightning_aio._core.group.drivers.wait import Procedure
    from rlightning_aio._core.hosts.base import Source

WORK = Work(no_work.NO_WORK, num_envs=1, modules=("no_work",))

FACADE = "rlightning_aio sync"
RAW = "its core, driven raw"


class RawDriver:
    """Blocks in `poll` and resumes; without time limits, writing and cleaning up."""

    def __init__(self) -> None:
        self._poll = select.poll()
        self._sources: dict[int, Source] = {}
        self._descriptors: dict[Source, int] = {}

    def watch(self, source: Source) -> None:
        self._descriptors[source] = source.fileno()
        self._sources[source.fileno()] = source
        self._poll.register(source.fileno(), select.POLLIN)

    def unwatch(self, source: Source) -> None:
        descriptor = self._descriptors.pop(source, None)
        if descriptor is not None:
            del self._sources[descriptor]
            self._poll.unregister(descriptor)

    def watch_writable(self, source: Source, wanted: bool) -> None:
        assert not wanted, f"a request of one env fits the channel of {source}"

    def wake(self) -> None:
        """Do nothing: `run` resumes after every read."""

    def check_interrupt(self) -> None:
        """Do nothing: it holds no Ctrl-C back."""

    def run(self, procedure: Procedure[Any]) -> Any:
        try:
            wait = procedure.send(None)  # pyright: ignore[reportArgumentType]
            while True:
                for descriptor, _ in self._poll.poll(None if wait.until is None else 0):
                    self._sources[descriptor].on_readable()
                self.apply_completions()
                wait = procedure.send(time.monotonic())
        except StopIteration as stop:
            return stop.value


@dataclass
class Raw(Stepped):
    package = "rlightning_aio"

    def setup(self) -> None:
        from rlightning_aio._core.group.setup.build import assemble
        from rlightning_aio._core.group.setup.plan import plan_group

        self._driver = RawDriver()
        config = group_config(self.work, "auto")
        plan = plan_group(config, {}, None, mixed_actions=False, zero_copy=False)
        self._core = assemble(plan, self._driver, shares_thread=False)
        self._driver.apply_completions = self._core.apply_completions
        metas = self._driver.run(self._core.start(time.monotonic()))
        self._actions = sampled(metas[0].action_space, self.work.num_envs)

    def round(self, seconds: float) -> float:
        core, run = self._core, self._driver.run
        batch, _ = run(core.reset(time.monotonic(), None, None, None))
        response = batch.respond(action=next(self._actions))
        return median_us(lambda: run(core.steps.step(response, time.monotonic())), seconds)

    def teardown(self) -> None:
        if hasattr(self, "_core"):
            self._driver.run(self._core.close(time.monotonic()))


QUESTION = Question(
    name="facade",
    title="A call of step, 1 env without work in 1 worker",
    unit="µs",
    contenders=[SyncCalls(FACADE, WORK, auto_reset=False), Raw(RAW, WORK)],
    targets=[Target(FACADE, RAW, 10.0, at_most=True, difference=True)],
    seconds=1.0,
    counts_steps=False,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
