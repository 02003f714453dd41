"""The cost of `on_worker_death: resume` while no worker dies, in processor time.

Steps a task in workers, with and without `snapshot_every`, in alternating rounds in one run. Prints
the processor time per step of the trainer and all its descendants, and the ratio: the median over
pairs of the same round.
"""

from __future__ import annotations

import argparse
import json
from contextlib import ExitStack

import psutil

from rlightning_aio import sync
from rlightning_aio.cli.measurement import Figures


def processor_seconds() -> float:
    """Return the processor time of this process and its descendants."""
    me = psutil.Process()
    times = [process.cpu_times() for process in (me, *me.children(recursive=True))]
    return sum(own.user + own.system for own in times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--backend", default="mujoco")
    parser.add_argument("--task", default="HalfCheetah-v5")
    parser.add_argument("--envs", type=int, default=8)
    parser.add_argument("--every", type=int, nargs="+", default=[10, 100, 1000])
    parser.add_argument("--steps", type=int, default=2000, help="of each env in a round")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    entry = {
        "name": "e",
        "backend": arguments.backend,
        "task": arguments.task,
        "num_workers": arguments.envs,
    }
    keeping = [{"on_worker_death": "resume", "snapshot_every": n} for n in arguments.every]
    spent: list[list[float]] = [[] for _ in range(1 + len(keeping))]
    for _ in range(arguments.rounds):
        for figures, fields in zip(spent, [{}, *keeping], strict=True):
            # One group at a time: other groups would use processor time, too, if they spin.
            with ExitStack() as stack:
                group = stack.enter_context(sync.build_env_group({**entry, **fields}))
                batch, _ = group.reset(seed=0)
                space = group.get_action_spaces()[0]
                assert space is not None
                action = [space.sample() for _ in range(arguments.envs)]
                began = processor_seconds()
                with group.auto_reset():
                    for _ in range(arguments.steps):
                        batch, _ = group.step(batch.respond(action=action))
                seconds = processor_seconds() - began
            figures.append(1e6 * seconds / arguments.steps / arguments.envs)
    found = {
        str(every): {
            "us_per_step": Figures(figures).median,
            "ratio": Figures(figures).over(Figures(spent[0])).median,
        }
        for every, figures in zip(["never", *arguments.every], spent, strict=True)
    }
    if arguments.json:
        print(json.dumps(found))
        return
    print(f"{arguments.task}, {arguments.envs} envs: processor time of all processes")
    for every, figures in found.items():
        print(
            f"kept every {every:>6} steps: {figures['us_per_step']:8.1f} µs a step, "
            f"{figures['ratio']:.3f} times that without"
        )


if __name__ == "__main__":
    main()
