"""A queue of episodes while workers are killed, abort, hang and exit, and so is the evaluation.

The evaluation is a separate process. It is killed with SIGKILL after a number of episodes, and
started again from its file. At the end each (task, seed) must be in the file exactly once, with the
same return, length and success as without faults.

    python benchmarks/queue_faults.py                      # 1,000 episodes, 200 faults, 10 kills
    python benchmarks/queue_faults.py --episodes 60 --faults 4 --kills 2
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from queue_walk import KINDS, TASKS, Walk, lay_faults, policy

from rlightning_aio import sync
from rlightning_aio.evaluation import EpisodeSpec, QueueEvaluation, ResultsFile, evaluate


def specs(count: int) -> list[EpisodeSpec]:
    """Return `count` episodes, of all tasks in turn."""
    return [EpisodeSpec(TASKS[k % len(TASKS)], k // len(TASKS)) for k in range(count)]


def without_faults(count: int) -> QueueEvaluation:
    entry = {"name": "walk", "make_env": Walk, "num_workers": 4, "placement": "inline"}
    with sync.build_env_group(entry) as group, group.auto_reset(1000):
        return evaluate(group, policy, specs(count))


def evaluation(count: int, file: Path, faults: Path, step_timeout: float) -> None:
    """Evaluate from the file's state, and print a line for each episode."""
    entry = {
        "name": "walk", "make_env": Walk, "env_kwargs": {"faults": str(faults)}, "num_workers": 8,
        "envs_per_process": 2, "step_timeout": step_timeout, "max_restarts": 10_000,
    }  # fmt: skip

    def say(record: Any) -> None:
        sys.stdout.write(f"{record.task} {record.seed}\n")
        sys.stdout.flush()

    with (
        ResultsFile(file) as results,
        sync.build_env_group(entry) as group,
        group.auto_reset(1000),
    ):
        evaluate(group, policy, specs(count), max_attempts=1000, results=results, on_episode=say)


def killed_and_resumed(words: list[str], episodes: int, kills: int) -> int:
    """Run the evaluation to its end, killing it `kills` times. Return the number of its starts."""
    every = episodes // (kills + 1)
    starts = 0
    while True:
        starts += 1
        command = [sys.executable, __file__, "--evaluation", *words]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            if starts <= kills:
                for _ in range(every):
                    assert child.stdout.readline(), "the evaluation has ended by itself"
                child.kill()
                continue
            child.stdout.read()
        assert child.returncode == 0
        return starts


def outcomes(records: list[Any]) -> dict[Any, Any]:
    assert len({record.key for record in records}) == len(records)
    return {one.key: (one.total_reward, one.length, one.success, one.cause) for one in records}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--step-timeout", type=float, default=2.0)
    parser.add_argument("--evaluation", nargs=2, metavar=("FILE", "FAULTS"))
    args = parser.parse_args()
    if args.evaluation is not None:
        file, faults = map(Path, args.evaluation)
        evaluation(args.episodes, file, faults, args.step_timeout)
        return
    with tempfile.TemporaryDirectory() as folder:
        file, faults = Path(folder, "results.jsonl"), Path(folder, "faults")
        lay_faults(faults, args.faults)
        begun = time.monotonic()
        words = [str(file), str(faults), "--episodes", str(args.episodes)]
        starts = killed_and_resumed(
            [*words, "--step-timeout", str(args.step_timeout)], args.episodes, args.kills
        )
        seconds = time.monotonic() - begun
        with ResultsFile(file) as results:
            found = results.played
        suffered = args.faults - len(list(faults.iterdir()))
    assert outcomes(found) == outcomes(without_faults(args.episodes).records)
    lost = sum(len(record.lost) for record in found)
    print(
        f"{len(found)} episodes in {seconds:.0f} s, each once and as without faults: {suffered} "
        f"faults ({', '.join(KINDS)}), {lost} lost attempts of finished episodes, {starts} starts"
    )


if __name__ == "__main__":
    main()
