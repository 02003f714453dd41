"""Train with every training example for a few minutes, and keep the learning curves.

    python benchmarks/curves.py            # four runs, ten minutes; requirements/examples.txt
    python benchmarks/curves.py sac        # one of them

Writes `results/curves.json`, and `results/curves.png` where matplotlib is installed. The curves
show that the examples learn; `training.py` compares them with other libraries, over more steps.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from harness import machine_facts

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
# Arguments beside the task's own; SAC has no preset for a small task.
RUNS: dict[str, tuple[str, ...]] = {
    "ppo": ("--task", "CartPole-v1", "--total-steps", "150000"),
    "ppo_async": ("--task", "CartPole-v1", "--total-steps", "150000"),
    "ppo_overlap": ("--task", "CartPole-v1", "--total-steps", "150000"),
    "sac": (
        "--task", "Pendulum-v1", "--backend", "gymnasium", "--total-steps", "12000",
        "--learning-starts", "1000", "--hidden", "64",
    ),
}  # fmt: skip
POINTS = 60


def curve(example: str) -> dict[str, Any]:
    """Train, and return the columns of the run's `curve.csv`, thinned out."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, f"examples/{example}.py", *RUNS[example], "--folder", folder]
        subprocess.run(command, cwd=ROOT, check=True)
        with (Path(folder) / "curve.csv").open() as file:
            # Before the first episode has ended, there is no return.
            rows = [row for row in csv.DictReader(file) if row["return"] != "nan"]
    kept = [rows[k * (len(rows) - 1) // (POINTS - 1)] for k in range(POINTS)]
    return {
        "arguments": list(RUNS[example]),
        **{name: [float(row[name]) for row in kept] for name in ("steps", "seconds", "return")},
    }


def draw(curves: dict[str, Any], path: Path) -> None:
    """Draw return by transitions, one panel for each example."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, len(curves), figsize=(11, 2.8), layout="constrained")
    for axes, (example, found) in zip(panels, curves.items(), strict=True):
        axes.plot(found["steps"], found["return"])
        axes.set_title(f"{example}.py, {found['arguments'][1]}", fontsize=9)
        axes.set_xlabel("transitions", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.ticklabel_format(axis="x", style="sci", scilimits=(0, 0))
    panels[0].set_ylabel("mean return of 100 episodes", fontsize=8)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("examples", nargs="*", metavar="EXAMPLE", help="default: all")
    chosen = parser.parse_args().examples or list(RUNS)
    if unknown := set(chosen) - set(RUNS):
        parser.error(f"no such example: {', '.join(sorted(unknown))}")
    file = RESULTS / "curves.json"
    kept = json.loads(file.read_text())["curves"] if file.exists() else {}
    kept.update({example: curve(example) for example in chosen})
    curves = {example: kept[example] for example in RUNS if example in kept}
    file.write_text(
        json.dumps({"machine": machine_facts(["torch"]), "curves": curves}, indent=1) + "\n"
    )
    if find_spec("matplotlib") is not None:
        draw(curves, RESULTS / "curves.png")


if __name__ == "__main__":
    main()
