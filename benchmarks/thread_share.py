"""What does a step cost the trainer's thread, outside of the part that all cores share?

More cores shorten the simulations, not this part. It is the thread's own processor time
(`time.thread_time`), so other programs hardly matter. Of `make_vec`, calls of MuJoCo's batches are
left out; of EnvPool, whose simulations run in threads of their own, all of the main thread counts,
short spinning for results included. The second table is a model, not a measurement: a step of all
takes the trainer's part, and all other processor time divided by the cores.
The third table is for envs that do nothing, in workers, and as coroutines of the trainer's thread,
where the envs' own part counts.
"""

from __future__ import annotations

import asyncio
import json
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from contenders import EnvPool, MakeVec, OursSync, Work
from harness import Contender, arguments, machine_facts, modules_of, number_text, say, take_turns
from no_work import NO_WORK, AwaitsNothing

from rlightning_aio.cli.measurement import Figures

if TYPE_CHECKING:
    from collections.abc import Callable

WORKS = {
    ("HalfCheetah-v5", 32): 0.75,
    ("HalfCheetah-v5", 256): 0.5,
    ("HalfCheetah-v5", 1024): 0.5,
    ("Hopper-v5", 256): 0.5,
    ("Ant-v5", 256): 0.5,
    ("Humanoid-v5", 256): 0.5,
}
"""The maximum ratio to EnvPool of a task and a number of simulations."""
EACH = {
    ("plain Python envs in workers", 256): 0.3,
    ("plain Python envs in workers", 1024): None,
    ("awaitable envs", 256): None,
    ("awaitable envs", 1024): None,
}
"""The maximum µs of the trainer for a result, of envs that do nothing."""
MODELLED = (16, 64, 128)
"""Numbers of cores of the model."""
PARALLEL = ("mjb_step", "mjb_apply", "mjb_forward", "mjb_reset")
"""Calls that MuJoCo's threads share."""
WARM_UP = 60
"""Steps before the first round, after which falls no longer come all at once."""


class Serial:
    """A contender whose rounds return the trainer's µs in a step of all, and steps per second."""

    step: Callable[[], int]
    _inside = 0.0

    def prepare(self) -> None:
        for _ in range(WARM_UP):
            self.step()

    def round(self, seconds: float) -> tuple[float, float]:
        for _ in range(3):
            self.step()
        count, began, self._inside = 0, time.perf_counter(), 0.0
        busy = time.thread_time()
        while time.perf_counter() < began + seconds:
            self.step()
            count += 1
        busy = time.thread_time() - busy - self._inside
        return 1e6 * busy / count, count / (time.perf_counter() - began)


class Ours(Serial, MakeVec):
    """`make_vec`, with MuJoCo's parallel calls left out."""

    def setup(self) -> None:
        from rlightning_aio.envs.mujoco import threads

        library = threads._library()  # noqa: SLF001  # As its calls are timed.
        for name in PARALLEL:
            setattr(library, name, self._timed(getattr(library, name)))
        super().setup()
        self.prepare()

    def _timed(self, call: Callable[..., int]) -> Callable[..., int]:
        def timed(*args: Any) -> int:
            began = time.thread_time()
            found = call(*args)
            self._inside += time.thread_time() - began
            return found

        return timed


class Pool(Serial, EnvPool):
    """EnvPool's main thread."""

    def setup(self) -> None:
        super().setup()
        self.prepare()


class Plain(Serial, OursSync):
    """Envs in workers; all are stepped and awaited."""

    def setup(self) -> None:
        super().setup()
        self.prepare()


class Awaitable(Serial, Contender):
    """Envs whose `step` is a coroutine, on the event loop of the trainer's thread."""

    def __init__(self, name: str, count: int) -> None:
        self.name, self._count = name, count

    @property
    def requires(self) -> tuple[str, ...]:
        return ("rlightning_aio",)

    def setup(self) -> None:
        from rlightning_aio import build_env_group

        makers = [AwaitsNothing] * self._count
        self._envs = build_env_group({"name": "env", "task": makers, "placement": "loop"})
        self._runner = asyncio.Runner()
        self._runner.run(self._envs.init())
        self._batch, _ = self._runner.run(self._envs.reset(seed=0))
        self._actions = np.zeros((self._count, 2), np.float32)
        self.prepare()

    def step(self) -> int:
        step = self._envs.step(self._batch.respond(action=self._actions))
        self._batch, _ = self._runner.run(step)
        _ = self._batch.observation, self._batch.reward
        return self._count

    def teardown(self) -> None:
        self._runner.run(self._envs.close())
        self._runner.close()


def name_of(task: str, count: int) -> str:
    return f"{task.removesuffix('-v5')} x {count:,}"


contenders: list[Contender] = []
for task, count in WORKS:
    work = Work(task, count, backend="mujoco")
    contenders += [
        Ours(f"make_vec, {name_of(task, count)}", work),
        Pool(f"EnvPool, {name_of(task, count)}", work),
    ]
for kind, count in EACH:
    name = name_of(kind, count)
    if kind == "awaitable envs":
        contenders.append(Awaitable(name, count))
    else:
        contenders.append(Plain(name, Work(NO_WORK, count), auto_reset=False))


def medians(rounds: list[tuple[Any, Any]]) -> tuple[float, float]:
    """µs of the trainer and other µs of processor time, in a step of all."""
    outside = Figures([value[0] for value, _ in rounds]).median
    all_us = Figures([1e6 * load.cores / value[1] for value, load in rounds]).median
    return outside, all_us - outside


def tables(turns: dict[str, list[tuple[Any, Any]]]) -> str:
    """Return the measured table, and the model."""
    lines = [
        "| Trainer's µs in a step of all | make_vec | EnvPool | ratio | low to high | target | |",
        "|---|---:|---:|---:|---:|---:|---|",
    ]
    model = [
        "| model, not measured: env steps/s | "
        + " | ".join(f"{cores} cores" for cores in MODELLED)
        + " |",
        "|---|" + "---:|" * len(MODELLED),
    ]
    for (task, count), bound in WORKS.items():
        pair = [
            turns.get(f"{kind}, {name_of(task, count)}", []) for kind in ("make_vec", "EnvPool")
        ]
        values = [Figures([value[0] for value, _ in rounds]) for rounds in pair]
        texts = [number_text(found.median) if found.values else "" for found in values]
        judged = "| | | |"
        if all(found.values for found in values):
            ratios = values[0].over(values[1])
            met = "met" if ratios.median <= bound else "missed"
            spread = f"{min(ratios.values):.2f} to {max(ratios.values):.2f}"
            judged = f"{ratios.median:.2f} | {spread} | ≤ {bound} | {met} |"
        lines.append(f"| {name_of(task, count)} | {' | '.join(texts)} | {judged}")
        for kind, rounds in zip(("make_vec", "EnvPool"), pair, strict=True):
            if rounds:
                outside, rest = medians(rounds)
                rates = (number_text(1e6 * count / (outside + rest / n)) for n in MODELLED)
                model.append(f"| {kind}, {name_of(task, count)} | {' | '.join(rates)} |")
    each = [
        "| Trainer's µs for a result | median | low to high | target | |",
        "|---|---:|---:|---:|---|",
    ]
    for (kind, count), bound in EACH.items():
        spent = [value[0] / count for value, _ in turns.get(name_of(kind, count), [])]
        if not spent:
            continue
        middle, judged = Figures(spent).median, "| |"
        if bound is not None:
            judged = f"≤ {bound} | {'met' if middle <= bound else 'missed'} |"
        spread = f"{min(spent):.2f} to {max(spent):.2f}"
        each.append(f"| {name_of(kind, count)} | {middle:.2f} | {spread} | {judged}")
    return "\n".join([*lines, "", *model, "", *each])


def main() -> None:
    args = arguments(__doc__, 7, 1.0)
    machine = machine_facts(modules_of(contenders))
    turns, skipped = take_turns(
        contenders, args.rounds, args.seconds, args.only, lambda found: f"{found[0]:.0f} µs"
    )
    report = {
        "name": "thread_share",
        "title": "The trainer's thread in a step",
        "rounds": args.rounds,
        "machine": machine,
        "results": {
            name: dict(zip(("outside_us", "other_us"), medians(rounds), strict=True))
            for name, rounds in turns.items()
        },
        "tables": tables(turns),
        "skipped": skipped,
    }
    say(report["tables"])
    if args.json:
        args.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
