"""PPO that learns in a thread of its own, while the next rollout is being collected.

    python examples/ppo_overlap.py                          # HalfCheetah-v5, 16 environments
    python examples/ppo_overlap.py --task CartPole-v1

Otherwise it is like ppo_async.py. Environments never wait for the learner, so it learns from
actions of the previous policy: one version old at most. PPO's clipped ratio to the probability
that the action had when it was chosen makes up for that.
"""

from __future__ import annotations

import asyncio
import sys
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np
import ppo_async
import torch
from ppo_async import Learner, entry_of, waiting
from training_run import Run, arguments

import rlightning_aio as rl
from rlightning_aio.collecting import Collector

MOST_LAG = 1
# Seconds for which the learner's thread may keep Python from the loop, which has envs to answer.
SWITCH_INTERVAL = 0.0005


@dataclass
class Args(ppo_async.Args):
    folder: str = "runs/ppo_overlap"


@dataclass
class CartPole(ppo_async.CartPole):
    folder: str = "runs/ppo_overlap"


async def train(args: Args | CartPole) -> Run:
    torch.manual_seed(args.seed)
    sys.setswitchinterval(SWITCH_INTERVAL)
    run = Run(args.total_steps, args.folder, args.resume)
    async with rl.build_env_group(entry_of(args)) as group:
        learner = Learner(args, group, run)
        player = learner.player
        collector = Collector(
            group,
            player,
            num_transitions=args.num_envs * args.envs_each * args.num_steps,
            min_batch=args.min_batch,
            seed=args.seed + run.steps,
        )
        trace = group.trace(args.trace) if args.trace else nullcontext()
        with group.auto_reset(), run, trace:
            rollout = await collector.collect()
            while run.goes_on():
                columns = learner.columns(rollout)
                lag = collector.policy_version - rollout.policy_version
                # What was in flight while the learner was slow can be older: left out.
                if lag.max() > MOST_LAG:
                    young = torch.from_numpy(np.flatnonzero(lag <= MOST_LAG))
                    columns = {name: column[young] for name, column in columns.items()}
                rate = args.learning_rate * run.remaining
                async with asyncio.TaskGroup() as both:
                    # Arrays of a rollout are its own until the next one but one.
                    collecting = both.create_task(collector.collect())
                    with run.learning(), group.span("learner"):
                        figures = await asyncio.to_thread(learner.learn, columns, rate)
                    player.take(learner.agent)
                    collector.policy_version += 1
                figures |= waiting(rollout) | {"lag": lag.clip(max=MOST_LAG).mean()}
                run.record(len(rollout), player.ended(), **figures)
                rollout = collecting.result()
                if len(run.rows) % args.save_every == 0:
                    run.save(learner.state())
            run.save(learner.state())
    return run


if __name__ == "__main__":
    trained = rl.run(train(arguments(Args, CartPole)))
    print({name: round(value, 3) for name, value in trained.rows[-1].items()})
