"""HalfCheetahs with 1, 2, 4, … of MuJoCo's threads, up to the number of cores.

The second table is a model, not a measurement: a step of all takes the trainer's share, which no
thread shortens, and the simulations' time divided by the threads. Both times come from the figures
of this run; memory, caches and clock rates that change with the load are left out.
"""

from __future__ import annotations

import json
import os

from contenders import MakeVec, Work
from harness import Contender, Question, arguments, measure, say, tables

CORES = len(os.sched_getaffinity(0))
COUNTS = (32, 256)
MODELLED = (16, 64)
"""Numbers of cores of the model."""


def thread_counts() -> list[int]:
    """Powers of two up to the number of cores."""
    return [1 << power for power in range(CORES.bit_length()) if 1 << power <= CORES]


def name_of(count: int, threads: int) -> str:
    return f"HalfCheetah x {count}, {threads} {'thread' if threads == 1 else 'threads'}"


contenders: list[Contender] = [
    MakeVec(name_of(count, threads), Work("HalfCheetah-v5", count), num_threads=threads)
    for count in COUNTS
    for threads in thread_counts()
]
QUESTION = Question(
    name="threads",
    title="make_vec with some of MuJoCo's threads",
    unit="env steps/s",
    contenders=contenders,
)


def modelled(rates: dict[int, float], count: int) -> tuple[float, float, dict[int, float]] | None:
    """Return the model of `count` simulations; None if threads were no faster, as on a busy
    machine.

    Args:
        rates: env steps per second by threads.
        count: number of simulations.

    Returns:
        The trainer's seconds for a step of all, the seconds of one simulation, and rates by cores.
    """
    few, many = min(rates), max(rates)
    alone, shared = count / rates[few], count / rates[many]
    # alone = trainer + count * one / few, and likewise with many.
    one = (alone - shared) / (count / few - count / many) if many > few else alone / count
    trainer = max(0.0, alone - count * one / few)
    if one <= 0:
        return None
    return trainer, one, {cores: count / (trainer + count * one / cores) for cores in MODELLED}


def model_table(medians: dict[str, float]) -> str:
    lines = ["| model, not measured | " + " | ".join(f"{cores} cores" for cores in MODELLED) + " |"]
    lines.append("|---|" + "---:|" * len(MODELLED))
    for count in COUNTS:
        rates = {t: medians[name_of(count, t)] for t in thread_counts()}
        model = modelled(rates, count)
        if model is None:
            lines.append(f"| HalfCheetah x {count}: threads were no help |" + " |" * len(MODELLED))
            continue
        trainer, one, found = model
        cells = " | ".join(f"{rate:,.0f}" for rate in found.values())
        parts = f"{trainer * 1e6:.0f} µs the trainer's, {one * 1e6:.0f} µs each simulation's"
        lines.append(f"| HalfCheetah x {count}: {parts} | {cells} |")
    return "\n".join(lines)


def main() -> None:
    args = arguments(__doc__, QUESTION.rounds, QUESTION.seconds)
    report = measure(QUESTION, args.rounds, args.seconds, args.only)
    report["tables"] = tables(report)
    if len(report["results"]) == len(contenders):
        medians = {name: found["median"] for name, found in report["results"].items()}
        report["tables"] += "\n\n" + model_table(medians)
    say(report["tables"])
    if args.json:
        args.json.write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
