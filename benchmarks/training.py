"""PPO on four workloads: how fast does it learn, and how much of the time is waiting for envs?

    python benchmarks/training.py --json training.json --plot training.png
    python benchmarks/training.py --only cheetah --seeds 1 --steps 20000

The baseline is CleanRL's loop on Gymnasium's vector environments (gymnasium_ppo.py), and in one
workload on `make_vec`'s and EnvPool's. Ours otherwise are `examples/ppo*.py`, with the same
network, hyperparameters, seeds and number of transitions.
Contenders take turns, seed by seed, each turn in its own process; a ratio is the median over seeds.
*Outside* is wall-clock less the learner's own time. A finished turn is saved in the folder and
isn't run again, so an interrupted run continues. All of it takes hours.
"""

from __future__ import annotations

import argparse
import asyncio
import importlib
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness import (
    JUDGED,
    ONE_THREAD,
    Figures,
    judged_row,
    machine_facts,
    machine_text,
    number_text,
    say,
)
from training_workloads import (
    BASELINES,
    BETTER,
    SPREAD,
    TOGETHER_WITH,
    WORKLOADS,
    Contender,
    Target,
    Workload,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "examples"))

# Episodes that ended in the last tenth of a run give its final return.
LAST = 0.1
# Number of points of a curve in the report.
POINTS = 40
CURVE = ("steps", "seconds", "return")


# ---- a turn


def turn(workload: Workload, contender: Contender, seed: int, steps: int, folder: Path) -> None:
    """Train once, in this process, and leave ``turn.json`` in the folder."""
    args: dict[str, Any] = {**workload.settings, "seed": seed, "folder": str(folder)}
    if steps:
        args["total_steps"] = steps
    if contender.name in (*BASELINES, *TOGETHER_WITH):
        ppo, baseline = importlib.import_module("ppo"), importlib.import_module("gymnasium_ppo")
        run, _ = baseline.train(getattr(ppo, workload.preset)(**args), contender.name)
    else:
        example = importlib.import_module(contender.example)
        run = example.train(getattr(example, workload.preset)(**args | contender.settings))
        if asyncio.iscoroutine(run):
            run = importlib.import_module("rlightning_aio").run(run)
    rows = run.rows
    wall, learner = rows[-1]["seconds"], rows[-1]["learner_seconds"]
    late = [row["return"] for row in rows if row["steps"] > (1 - LAST) * rows[-1]["steps"]]
    # A run without an account of its environments has no share of busy time.
    stepping = [row["stepping"] for row in rows if "stepping" in row]
    found = {
        "wall": wall,
        "learner": learner,
        "outside": wall - learner,
        "rate": rows[-1]["steps"] / wall,
        "return": statistics.fmean(late),
        "busy": statistics.fmean(stepping) / workload.num_envs if stepping else None,
        # There is no return before the end of the first episode.
        "curve": [
            [row[name] for name in CURVE]
            for row in rows[:: 1 + len(rows) // POINTS]
            if row["return"] == row["return"]
        ],
    }
    (folder / "turn.json").write_text(json.dumps(found))


def turns(
    workload: Workload, only: Sequence[str], seeds: int, steps: int, kept: Path
) -> dict[str, list[dict[str, Any]]]:
    """Return the results of each contender's turns, seed by seed; run the missing ones."""
    found: dict[str, list[dict[str, Any]]] = {}
    asked = [
        contender
        for contender in workload.contenders
        if not only or any(part in f"{workload.name}/{contender.name}" for part in only)
    ]
    for seed in range(1, seeds + 1):
        for contender in asked:
            folder = kept / workload.name / f"{contender.name}, {steps or 'all'} steps, {seed}"
            if not (folder / "turn.json").exists():
                command = [sys.executable, __file__, "--turn", workload.name, contender.name]
                command += [str(seed), str(steps), str(folder)]
                subprocess.run(command, check=True)
            brought = json.loads((folder / "turn.json").read_text())
            found.setdefault(contender.name, []).append(brought)
            say(
                f"  {workload.name}, seed {seed}  {contender.name:24} "
                f"{number_text(brought['wall'])} s, outside {number_text(brought['outside'])} s, "
                f"return {number_text(brought['return'])}"
            )
    return found


# ---- targets


def judged(target: Target, found: dict[str, list[dict[str, Any]]]) -> dict[str, Any] | None:
    """Return the target's figure for each seed and True if it is met; None if a contender is
    missing.
    """
    own = found.get(target.subject)
    baselines = [found[name] for name in BASELINES if name in found]
    if own is None or (not baselines and target.reference in (BETTER, SPREAD)):
        return None
    mine = [turn[target.what] for turn in own]
    if target.reference == SPREAD:
        values = [statistics.fmean(mine)]
        bound = min(turn[target.what] for turns in baselines for turn in turns)
    elif target.reference == BETTER:
        pick = min if target.at_most else max
        best = [pick(turn[target.what] for turn in seed) for seed in zip(*baselines, strict=True)]
        values, bound = [a / b for a, b in zip(mine, best, strict=True)], target.bound
    elif target.reference:
        if target.reference not in found:
            return None
        theirs = [turn[target.what] for turn in found[target.reference]]
        values, bound = [a / b for a, b in zip(mine, theirs, strict=True)], target.bound
    else:
        values, bound = mine, target.bound
    extreme, middle = (max if target.at_most else min)(values), Figures(values).median
    held = extreme if target.every else middle
    return {
        "subject": target.subject,
        "what": target.what,
        "reference": target.reference,
        "at_most": target.at_most,
        "every": target.every,
        "bound": bound,
        "values": values,
        "median": middle,
        "met": held <= bound if target.at_most else held >= bound,
    }


def report_of(workload: Workload, found: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    judgements = [judged(target, found) for target in workload.targets]
    return {
        "title": workload.title,
        "results": found,
        "targets": [judgement for judgement in judgements if judgement is not None],
    }


# ---- reports


def tables(report: dict[str, Any]) -> str:
    return "\n\n".join("\n".join(_lines(part)) for part in report["workloads"].values())


def _lines(part: dict[str, Any]) -> Iterator[str]:
    """Return one workload's two tables."""
    yield f"| {part['title']} | wall-clock, s | learner, s | outside, s | steps/s | return |"
    yield "|---|---:|---:|---:|---:|---:|"
    for name, turns in part["results"].items():
        kinds = ("wall", "learner", "outside", "rate")
        cells = [number_text(Figures([turn[kind] for turn in turns]).median) for kind in kinds]
        returns = [turn["return"] for turn in turns]
        spread = f"{number_text(min(returns))} to {number_text(max(returns))}"
        cells.append(f"{number_text(statistics.fmean(returns))} ({spread})")
        yield f"| {name} | {' | '.join(cells)} |"
    if part["targets"]:
        yield from ("", *JUDGED)
    for target in part["targets"]:
        who = f"{target['subject']}, {target['what']}"
        against = f" / {target['reference']}" if target["reference"] not in ("", SPREAD) else ""
        sign = "≤" if target["at_most"] else "≥"
        bound = f"{sign} {number_text(target['bound'])}{', each' if target['every'] else ''}"
        yield judged_row(who + against, Figures(target["values"]), bound, met=target["met"])


def plot(report: dict[str, Any], path: Path) -> None:
    """Plot return against steps and against wall-clock time, with a line for each seed."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    parts = list(report["workloads"].values())
    figure, grid = plt.subplots(
        len(parts), 2, figsize=(10, 3.2 * len(parts)), layout="constrained", squeeze=False
    )
    for axes, part in zip(grid, parts, strict=True):
        for number, (name, turns) in enumerate(part["results"].items()):
            for seed, turn in enumerate(turns):
                columns = {name: [p[k] for p in turn["curve"]] for k, name in enumerate(CURVE)}
                for place, along in zip(axes, ("steps", "seconds"), strict=True):
                    place.plot(
                        columns[along], columns["return"],
                        color=f"C{number}", alpha=0.7, linewidth=1, label=None if seed else name,
                    )  # fmt: skip
        axes[0].set_title(part["title"], fontsize=10, loc="left")
        axes[0].set_ylabel("return of the last 100 episodes")
        axes[0].set_xlabel("transitions")
        axes[1].set_xlabel("seconds")
        axes[1].legend(fontsize=7)
    figure.savefig(path, dpi=70)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=3, help="default: %(default)s")
    parser.add_argument("--steps", type=int, default=0, help="transitions, if not the preset's")
    parser.add_argument(
        "--only", action="append", default=[], metavar="PART",
        help="turns whose workload/contender holds PART; may be given more than once",
    )  # fmt: skip
    parser.add_argument("--folder", type=Path, default=Path("runs/training"), help="of the turns")
    parser.add_argument("--json", type=Path, help="write the report here")
    parser.add_argument("--plot", type=Path, help="draw the report here (needs matplotlib)")
    parser.add_argument("--turn", nargs=5, help=argparse.SUPPRESS)
    given = parser.parse_args()
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    if given.turn:
        name, contender, seed, steps, folder = given.turn
        (workload,) = (w for w in WORKLOADS if w.name == name)
        (chosen,) = (c for c in workload.contenders if c.name == contender)
        turn(workload, chosen, int(seed), int(steps), Path(folder))
        return
    machine = machine_facts({"torch"})
    workloads: dict[str, dict[str, Any]] = {}
    for workload in WORKLOADS:
        found = turns(workload, given.only, given.seeds, given.steps, given.folder.resolve())
        if found:
            workloads[workload.name] = report_of(workload, found)
    report = {
        "name": "training",
        "title": "PPO: return by transitions and by wall-clock",
        "rounds": given.seeds,
        "steps": given.steps or None,
        "machine": machine,
        "workloads": workloads,
    }
    report["tables"] = tables(report)
    print(f"{report['tables']}\n\n{machine_text(machine)}")
    if given.json:
        given.json.write_text(json.dumps(report) + "\n")
    if given.plot:
        plot(report, given.plot)


if __name__ == "__main__":
    main()
