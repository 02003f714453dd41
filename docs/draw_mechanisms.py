"""Draw how a group works, from timelines that are recorded here and now, into docs/pictures.

    python docs/draw_mechanisms.py

A picture is 400 units wide, so that its words can be read on a phone, and light or dark as the
reader's browser is. Envs sleep, so that nothing depends on the machine's cores.
"""

from __future__ import annotations

import json
import os
import tempfile
import threading
import time
from collections import defaultdict
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import gymnasium as gym
import numpy as np

from rlightning_aio.remote import RemoteEnvClient
from rlightning_aio.sync import build_env_group

LEFT, RIGHT, ROW = 84, 390, 20
STYLE = """text{font:12px sans-serif;fill:#222}.bold{font-weight:bold}.page{fill:#fff}
.row{fill:#f0f1f5}.step,.left{fill:#748ffc}.slow{fill:#ffa94d}.reset{fill:#51cf66}
.marked{fill:#ff6b6b}.empty{fill:#ced3de}.right{fill:#3bc9db}.third{fill:#e599f7}
@media(prefers-color-scheme:dark){text{fill:#eee}.page{fill:#1e2129}.row{fill:#2b2f3a}
.step,.left{fill:#4263eb}.slow{fill:#d9480f}.reset{fill:#2b8a3e}.marked{fill:#c92a2a}
.empty{fill:#4d5363}.right{fill:#0b7285}.third{fill:#862e9c}}"""
Slices = list[tuple[float, float, str]]  # Begin and end in ms, and ``class:words``.


class Sleeper(gym.Env[Any, Any]):
    """A step takes as many milliseconds as its action says; -1 ends its worker, -2 its client."""

    observation_space = action_space = gym.spaces.Box(-2.0, 1000.0, (1,), np.float32)

    def reset(self, **_: Any) -> Any:
        time.sleep(0.03)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        if action[0] == -1:
            os._exit(1)
        if action[0] == -2:  # It is a thread of this program.
            raise SystemExit
        time.sleep(float(action[0]) / 1000)
        return np.zeros(1, np.float32), 1.0, False, False, {}


def played(group: Any, ms: int, took: dict[str, list[int]], **rules: Any) -> tuple[Any, Any]:
    """Return the slices that `group.trace` records of each env, and the result of each.

    A step takes the next of the milliseconds in `took`, and the last one again and again.
    """
    results, slices = defaultdict[str, list[Any]](list), dict[str, Slices]()
    with tempfile.TemporaryDirectory() as folder:
        with group.trace(path := Path(folder) / "run.json"):
            end = time.monotonic() + ms / 1000 + 0.1
            group.reset_async()
            while time.monotonic() < end:
                batch, _ = group.collect_async(**rules)
                for row, env_id in enumerate(batch.ids()):
                    results[env_id].append(batch.take([row]))
                step = [took.get(e, [20])[: len(results[e])][-1] for e in batch.ids()]
                group.step_async(batch.respond(action=np.array(step, np.float32)[:, None]))
        events = json.loads(path.read_text())["traceEvents"]
    names = {e["args"]["name"]: e["tid"] for e in events if e["name"] == "thread_name"}
    for env_id in group.env_ids:
        own = [e for e in events if e["ph"] == "X" and e["tid"] == names[env_id]]
        times = sorted((e["ts"] / 1e3, (e["ts"] + e["dur"]) / 1e3, e["name"] + ":") for e in own)
        slices[env_id] = [one for one in times if one[1] < ms]
    return slices, results


def draw(name: str, ms: int, panels: dict[str, dict[str, Slices]], legend: dict[str, str]) -> None:
    """Draw panels below each other, and what the colours mean."""
    parts, y, x, scale = list[str](), 0, 10.0, (RIGHT - LEFT) / ms
    for heading, rows in panels.items():
        parts.append(_text(10, y + 8, heading, "bold"))
        y += 30
        for row, own in rows.items():
            parts += [_text(10, y, row), _box(LEFT, y, RIGHT - LEFT, "row")]
            shown = [(LEFT + a * scale, (b - a) * scale, *w.split(":")) for a, b, w in own]
            parts += [_box(at, y, length - 0.7, kind) for at, length, kind, _ in shown]
            parts += [_text(at + 4, y, words) for at, _, _, words in shown if words]
            y += ROW + 4
    for kind, words in legend.items():
        parts += [_box(x, y + 6, 12, kind), _text(x + 17, y + 6, words)]
        x += 32 + 6 * len(words)
    parts.append(_text(RIGHT - 52, y + 6, f"{ms} ms"))
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 400 {y + 34}" width="500">'
    page = f'<style>{STYLE}</style>\n<rect class="page" width="400" height="{y + 34}" rx="6"/>'
    picture = Path(__file__).with_name("pictures") / f"{name}.svg"
    picture.write_text("\n".join([head, page, *parts, "</svg>", ""]))


def _box(x: float, y: int, width: float, kind: str) -> str:
    return f'<rect class="{kind}" x="{x:.1f}" y="{y}" width="{width:.1f}" height="{ROW}"/>'


def _text(x: float, y: int, words: str, kind: str = "") -> str:
    return f'<text class="{kind}" x="{x:.1f}" y="{y + 14}">{escape(words)}</text>'


def main() -> None:
    """Wait for a slow env, and don't; kill a worker; have clients come and go."""
    panels = {}
    for call, waits in (("collect_async(wait_all=True)", True), ("collect_async()", False)):
        with build_env_group(Sleeper, name="env", num_workers=4) as group:
            rows, _ = played(group, 380, {"env-2": [80]}, wait_all=waits)
        rows["env-2"] = [(a, b, what.replace("step", "slow")) for a, b, what in rows["env-2"]]
        count = sum(what != "reset:" for own in rows.values() for *_, what in own)
        panels[f"{call}: {count} steps"] = rows
    draw("straggler", 380, panels, {"reset": "reset", "step": "step", "slow": "step, slow env"})
    with build_env_group(Sleeper, name="env", num_workers=2) as group:
        rows, results = played(group, 420, {"env-0": [50], "env-1": [50, 50, -1, 50]})
    own = rows["env-1"]
    for name in ("reward", "is_reset", "truncated", "restarted"):
        values = [getattr(result, name)[0] for result in results["env-1"]]
        words = [f"{one:g}" if name == "reward" else "yes" * int(one) for one in values]
        rows[name] = [(a, b, f"row:{word}") for (a, b, _), word in zip(own, words, strict=False)]
    k = values.index(True)  # Of `restarted`: the marked one.
    own[k : k + 1] = [(own[k - 1][1], own[k][0], "empty:"), (*own[k][:2], "marked:")]
    legend = {"reset": "reset", "step": "step", "empty": "worker died", "marked": "marked"}
    draw("lost_episode", 420, {"A worker dies: what env-1 returns": rows}, legend)
    with build_env_group(backend="env_server", name="arms", env_kwargs={"clients": 2}) as group:
        for name, after in (("left", 0.0), ("right", 0.32), ("third", 0.7)):
            client = RemoteEnvClient(Sleeper(), group["arms-0"].address, name=name, hardware=False)
            timer = threading.Timer(after, client.run)
            timer.daemon = True
            timer.start()
        rows, results = played(group, 1000, {"arms-0/0": [50] * 6 + [-2, 50], "arms-0/1": [50]})
    for env_id, own in rows.items():
        name, end, rows[env_id] = "", 0.0, []
        for (a, b, _), result in zip(own, results[env_id], strict=False):
            if client := result.info("client", "")[0]:
                rows[env_id].append((end, a, "empty:" + "its reset waits" * (a - end > 200)))
            name, end = client or name, b
            rows[env_id].append((a, b, f"{'marked' if result.restarted[0] else name}:{client}"))
    legend = {"left": "steps of a client", "empty": "no client", "marked": "marked result"}
    draw("places", 1000, {"Two places, three clients": rows}, legend)


if __name__ == "__main__":
    main()
