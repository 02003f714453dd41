"""PPO that learns in a separate process, while the next rollout is collected.

    python examples/ppo_overlap.py                          # HalfCheetah-v5, 16 environments
    python examples/ppo_overlap.py --task CartPole-v1

Otherwise it is like ppo_async.py. Environments never wait for the learner, so it learns from
actions of the previous policy: one version old at most. PPO's clipped ratio to the probability
that the action had when it was chosen makes up for that. A thread would share Python with the
loop that answers the environments, and each would wait for the other.
"""

from __future__ import annotations

import asyncio
import io
import multiprocessing
import os
import signal
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import ppo_async
import torch
from ppo_async import Learner, entry_of
from training_run import Run, arguments

import rlightning_aio as rl
from rlightning_aio.collecting import Collector

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

MOST_LAG = 1


@dataclass
class Args(ppo_async.Args):
    folder: str = "runs/ppo_overlap"


@dataclass
class CartPole(ppo_async.CartPole):
    folder: str = "runs/ppo_overlap"


class LearnerProcess:
    """Has the agent of `learner` learn in a process that shares its weights with this one.

    They change in place: nobody may read them before `learn` has returned.
    """

    def __init__(self, learner: Learner) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        learner.agent.share_memory()
        given = (learner, torch.get_rng_state(), theirs)
        self._process = context.Process(target=_learn, args=given, daemon=True)
        self._process.start()
        theirs.close()

    async def __aenter__(self) -> Self:
        await self.state()  # Once it answers, it has started.
        return self

    async def __aexit__(self, *error: object) -> None:
        self._process.terminate()
        self._process.join()

    async def learn(self, columns: dict[str, torch.Tensor], rate: float) -> dict[str, float]:
        return await self._ask(({name: column.numpy() for name, column in columns.items()}, rate))

    async def state(self) -> dict[str, Any]:
        """The learner process's part of a checkpoint: optimiser and random numbers."""
        return torch.load(io.BytesIO(await self._ask(None)), weights_only=True)

    async def _ask(self, what: Any) -> Any:
        loop, answered = asyncio.get_running_loop(), asyncio.Event()
        descriptor = self._pipe.fileno()
        try:
            self._pipe.send(what)
            loop.add_reader(descriptor, answered.set)
            try:
                await answered.wait()
            finally:
                loop.remove_reader(descriptor)
                os.set_blocking(descriptor, True)  # uvloop has made it non-blocking.
            return self._pipe.recv()
        except (EOFError, OSError):
            raise RuntimeError("the learner's process has ended; it says above why") from None


def _learn(learner: Learner, random: torch.Tensor, pipe: Connection) -> None:
    """Run in the process: make an update for each rollout, until the connection ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # The trainer handles Ctrl-C.
    torch.set_rng_state(random)
    with suppress(EOFError):
        while True:
            given = pipe.recv()
            if given is None:
                state = {"optimizer": learner.optimizer.state_dict()}
                written = io.BytesIO()
                torch.save(state | {"random": torch.get_rng_state()}, written)
                pipe.send(written.getvalue())
            else:
                columns, rate = given
                tensors = {name: torch.from_numpy(column) for name, column in columns.items()}
                pipe.send(learner.learn(tensors, rate))


async def train(args: Args | CartPole) -> Run:
    torch.manual_seed(args.seed)
    run = Run(args.total_steps, args.folder, args.resume)
    async with rl.build_env_group(entry_of(args)) as group:
        learner = Learner(args, group, run)
        player = learner.player
        collector = Collector(
            group,
            player,
            num_transitions=args.num_envs * args.envs_each * args.num_steps,
            min_results=args.min_results,
            seed=args.seed + run.steps,
        )
        trace = group.trace(args.trace) if args.trace else nullcontext()
        async with LearnerProcess(learner) as apart:
            with run, trace:
                rollout = await collector.collect()
                while run.goes_on():
                    columns = learner.columns(rollout)
                    lag = collector.policy_version - rollout.policy_version
                    # Leave out older transitions, in flight while the learner was slow.
                    if lag.max() > MOST_LAG:
                        young = torch.from_numpy(np.flatnonzero(lag <= MOST_LAG))
                        columns = {name: column[young] for name, column in columns.items()}
                    rate = args.learning_rate * run.remaining
                    async with asyncio.TaskGroup() as both:
                        # Arrays of a rollout are valid until the second one after it.
                        collecting = both.create_task(collector.collect())
                        with run.learning(), group.span("learner"):
                            figures = await apart.learn(columns, rate)
                        player.take(learner.agent)
                        collector.policy_version += 1
                    figures["lag"] = lag.clip(max=MOST_LAG).mean()
                    returns = rollout.episodes["total_reward"].tolist()
                    run.record(len(rollout), returns, **figures)
                    rollout = collecting.result()
                    if len(run.rows) % args.save_every == 0:
                        run.save(learner.state() | await apart.state())
                run.save(learner.state() | await apart.state())
    return run


if __name__ == "__main__":
    trained = rl.run(train(arguments(Args, CartPole)))
    print({name: round(value, 3) for name, value in trained.rows[-1].items()})
