"""Draw the pictures of docs/metrics.md from timelines that are recorded here and now.

    python docs/draw_timelines.py

Needs matplotlib. Environments sleep, so that what is drawn doesn't depend on the machine's cores.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import matplotlib as mpl
import numpy as np

from rlightning_aio import EnvConfig
from rlightning_aio.sync import build_env_group

mpl.use("Agg")
from matplotlib import pyplot as plt

if TYPE_CHECKING:
    from collections.abc import Callable

HERE = Path(__file__).resolve().parent
NUM_ENVS = 4
COLORS = {
    "step": "#4c78a8",
    "reset": "#f58518",
    "collect_async": "#d8dce4",
    "step_async": "#72b7b2",
    "policy": "#b279a2",
    "learner": "#e45756",
}
TURNS = 12
RECORDINGS = 8
WINDOW_MS = 240.0


class Sleeper(gym.Env[Any, Any]):
    """A step takes as many milliseconds as its action says."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = gym.spaces.Box(0.0, 100.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed, options=options)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        time.sleep(float(action[0]) / 1000)
        return np.zeros(1, np.float32), 0.0, False, False, {}


def collect(group: Any, milliseconds: list[float], learn_every: int = 0) -> None:
    """Step all envs together, each step of an env as long as it is said for that one."""
    taken = np.array(milliseconds, np.float32)[:, None]
    batch, _ = group.reset()
    for turn in range(1, TURNS + 1):
        with group.span("policy"):
            time.sleep(0.004)
            actions = taken[batch.index]
        group.step_async(batch.respond(action=actions))
        batch, _ = group.collect_async(wait_all=True)
        if learn_every and turn % learn_every == 0:
            with group.span("learner"):
                time.sleep(0.06)


def even(group: Any) -> None:
    """All envs take the same time."""
    collect(group, [30.0] * NUM_ENVS)


def straggler(group: Any) -> None:
    """One env takes four times as long as the others."""
    collect(group, [20.0, 20.0, 80.0, 20.0])


def learner(group: Any) -> None:
    """The trainer learns while the envs wait for it."""
    collect(group, [20.0] * NUM_ENVS, learn_every=2)


def recorded(what: Callable[[Any], None]) -> list[dict[str, Any]]:
    """The events of a timeline of `what`."""
    config = EnvConfig(name="env", task=Sleeper, num_workers=NUM_ENVS, envs_per_process=1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.json"
        with build_env_group(config) as group:
            group.reset()
            with group.trace(path):
                what(group)
        return json.loads(path.read_text())["traceEvents"]


def length(events: list[dict[str, Any]]) -> float:
    """From the first slice to the last."""
    return max(event["ts"] for event in events if event["ph"] == "X")


def draw(events: list[dict[str, Any]], path: Path) -> None:
    """A window from the middle: a row for each track, what is within a slice on top of it."""
    names: dict[tuple[int, int], str] = {}
    slices: defaultdict[tuple[int, int], list[tuple[float, float, str]]] = defaultdict(list)
    for event in events:
        track = event["pid"], event.get("tid", 0)
        if event["ph"] == "M" and event["name"] == "thread_name":
            names[track] = event["args"]["name"]
        elif event["ph"] == "X" and event["name"] in COLORS:
            slices[track].append((event["ts"] / 1e3, event["dur"] / 1e3, event["name"]))
    shown = sorted(names)
    figure, axes = plt.subplots(figsize=(9, 0.42 * len(shown) + 1.3), layout="constrained")
    middle = sum(slices[shown[0]][-1][:2]) / 2
    for row, track in enumerate(shown):
        axes.axhspan(row - 0.4, row + 0.4, color="#f7f7f7")
        # Those around others first, so that what is within them is seen.
        for began, length, name in sorted(slices[track], key=lambda one: -one[1]):
            if began < middle + WINDOW_MS and began + length > middle:
                axes.barh(row, length, 0.8, began - middle, color=COLORS[name], linewidth=0)
    used = {name for track in shown for began, _, name in slices[track] if began > middle}
    handles = [plt.Rectangle((0, 0), 1, 1, color=COLORS[name]) for name in COLORS if name in used]
    labels = [name for name in COLORS if name in used]
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8)
    axes.set_yticks(range(len(shown)), [names[track] for track in shown], fontsize=8)
    axes.set(xlim=(0, WINDOW_MS), xlabel="ms")
    axes.invert_yaxis()
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(left=False)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main() -> None:
    """Draw all of them, beside this script."""
    for what in (even, straggler, learner):
        # Of a few, that in which nothing else kept the machine busy.
        events = min((recorded(what) for _ in range(RECORDINGS)), key=length)
        draw(events, HERE / f"timeline_{what.__name__}.png")


if __name__ == "__main__":
    main()
