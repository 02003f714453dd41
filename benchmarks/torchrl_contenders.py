"""TorchRL's environments as contenders: `ParallelEnv`, and `AsyncEnvPool` with shared memory.

Rule: as in `contenders`; TorchRL resets in the step that ends an episode.
"""

from __future__ import annotations

import multiprocessing as mp
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from contenders import Stepped, Work, sampled

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def forking() -> Iterator[None]:
    """Start processes by forking in this context.

    By default each of TorchRL's processes imports torch, which takes minutes in all; their speed
    afterwards is the same.
    """
    import torch
    import torchrl  # noqa: F401  It sets the method when it is imported.

    # Torch's threads don't survive a fork.
    threads, method = torch.get_num_threads(), mp.get_start_method()
    torch.set_num_threads(1)
    mp.set_start_method("fork", force=True)
    try:
        yield
    finally:
        mp.set_start_method(method, force=True)
        torch.set_num_threads(threads)


@dataclass(frozen=True)
class Wrapped:
    """Makes one env of `work`, as TorchRL has it."""

    work: Work

    def __call__(self) -> Any:
        from torchrl.envs import GymWrapper

        return GymWrapper(self.work.make(), categorical_action_encoding=True)


@dataclass
class TorchRL(Stepped):
    """A contender with TorchRL's interface."""

    package = "torchrl"

    def make(self) -> Any:
        """Make all envs."""
        raise NotImplementedError

    def setup(self) -> None:
        import torch

        single = self.work.make()
        batches = sampled(single.action_space, self.work.num_envs)
        single.close()
        self._actions = map(torch.as_tensor, batches)
        with forking():
            self._envs = self.make()
            self._state = self._envs.reset()
        self._state["action"] = next(self._actions)

    def teardown(self) -> None:
        if self._envs is not None:
            self._envs.close(raise_if_closed=False)


@dataclass
class TorchRLParallel(TorchRL):
    """`ParallelEnv`: one process for each env, all of them in step."""

    def make(self) -> Any:
        from torchrl.envs import ParallelEnv

        makers = [Wrapped(self.work)] * self.work.num_envs
        return ParallelEnv(self.work.num_envs, makers, mp_start_method="fork")

    def step(self) -> int:
        _, self._state = self._envs.step_and_maybe_reset(self._state)
        self._state["action"] = next(self._actions)
        return self.work.num_envs


@dataclass
class TorchRLAsync(TorchRL):
    """`AsyncEnvPool` of processes.

    Attributes:
        min_results: number of results that a receive waits for; all envs if None.
        envs_per_worker: in each process, a thread for each of them.
    """

    min_results: int | None = None
    envs_per_worker: int = 1

    def make(self) -> Any:
        from torchrl.envs import AsyncEnvPool

        return AsyncEnvPool(
            [Wrapped(self.work)] * self.work.num_envs,
            backend="multiprocessing",
            exchange="shm",
            envs_per_worker=self.envs_per_worker,
        )

    def setup(self) -> None:
        super().setup()
        self._envs.async_step_and_maybe_reset_send(self._state)

    def step(self) -> int:
        wanted = self.min_results or self.work.num_envs
        _, state = self._envs.async_step_and_maybe_reset_recv(min_get=wanted)
        count = len(state)
        state["action"] = next(self._actions)[:count]
        self._envs.async_step_and_maybe_reset_send(state)
        return count
