"""One task and a number of envs: this library beside every peer that is installed.

    python benchmarks/compare.py HalfCheetah-v5 32
    python benchmarks/compare.py ale_py:ALE/Pong-v5 8
    python benchmarks/compare.py waiting:benchmarks/Uneven-v0 64 --ready 1 --envs-per-process 1
    python benchmarks/compare.py HalfCheetah-v5 32 --beside ../other_checkout --only rlightning_aio

Contenders take turns, each in a process of its own; a figure is the median of its rounds, and a
multiple that of `AsyncVectorEnv` in the same round. *K of N* hands out K results or more at a time,
whichever are ready first, while the other envs step. What this library runs in workers has time
limits. `pip install . -r requirements/bench.txt` brings the peers; those that are missing, or don't
have the task, are left out, with the reason. `run_all.py` draws the README's picture from a report.
"""

from __future__ import annotations

from contenders import (
    EnvPool,
    GymnasiumVector,
    OursAsync,
    OursSb3,
    OursSync,
    OursVector,
    Sb3Vector,
    TorchRL,
    TorchRLPool,
    Work,
)
from harness import STEPS, Question, Target, measure, parser_of, tell

MADE, VECTOR, ALL = (f"rlightning_aio {name}" for name in ("make_vec", "VectorEnv", "group, all"))
OURS_SB3 = "rlightning_aio sb3.VecEnv"
DEFAULT, ASYNC = "Gymnasium make_vec", "Gymnasium AsyncVectorEnv"
SUBPROC = "SB3 SubprocVecEnv"
BOUNDS = {"HalfCheetah-v5-32": 4.0, "CartPole-v1-64": 10.0, "Pong-v5-8": 1.5}
"""The least that `make_vec` should be as a multiple of `AsyncVectorEnv`; elsewhere once."""


def name_of(task: str, num_envs: int) -> str:
    """Return the name of the results of a task and a number of envs."""
    return f"{task.replace(':', '/').rpartition('/')[2]}-{num_envs}"


def question(work: Work, ready: int) -> Question:
    """Compare everybody at `work`; those that can hand out the first `ready` results."""
    name, some = name_of(work.task, work.num_envs), f"{ready} of {work.num_envs}"
    first, pool = f"rlightning_aio group, {some}", f"TorchRL AsyncEnvPool, {some}"
    return Question(
        name=name,
        title=f"{work.task.rpartition(':')[2]}, {work.num_envs} envs",
        unit=STEPS,
        contenders=[
            OursVector(MADE, work),
            OursVector(VECTOR, work, "async"),
            OursSb3(OURS_SB3, work),
            OursSync(ALL, work),
            OursAsync(first, work, ready),
            GymnasiumVector(DEFAULT, work),
            GymnasiumVector("Gymnasium SyncVectorEnv", work, "sync"),
            GymnasiumVector(ASYNC, work, "async"),
            Sb3Vector("SB3 DummyVecEnv", work, "DummyVecEnv"),
            Sb3Vector(SUBPROC, work),
            EnvPool("EnvPool, all", work),
            EnvPool(f"EnvPool, {some}", work, ready),
            TorchRL("TorchRL ParallelEnv", work),
            TorchRLPool(pool, work, ready),
        ],
        targets=[
            Target(MADE, DEFAULT, 1.0),
            Target(MADE, ASYNC, BOUNDS.get(name, 1.0)),
            Target(VECTOR, ASYNC, 1.0),
            Target(VECTOR, ALL, 0.85),
            Target(OURS_SB3, SUBPROC, 1.0),
            Target(first, pool, 1.0),
        ],
        reference=ASYNC,
        rounds=5,
    )


def main() -> None:
    parser = parser_of(__doc__, rounds=5, seconds=1.0)
    parser.add_argument("task", metavar="TASK", help="an id of Gymnasium's, or module:id")
    parser.add_argument("num_envs", metavar="N", type=int)
    parser.add_argument("--ready", type=int, metavar="K", help="default: half of the envs")
    parser.add_argument(
        "--step-timeout", type=float, default=60.0, help="of ours; 0: none (default: %(default)s)"
    )
    parser.add_argument(
        "--envs-per-process", type=int, metavar="K", help="default: the library's own choice"
    )
    given = parser.parse_args()
    limit = given.step_timeout or None
    work = Work(given.task, given.num_envs, limit, given.envs_per_process)
    report = measure(question(work, given.ready or max(1, given.num_envs // 2)), given)
    report["step_timeout"] = limit
    tell(report, given)


if __name__ == "__main__":
    main()
