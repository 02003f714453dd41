"""The live display on a terminal, and tables that fit it."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import Any, cast

import pytest
from rich.console import Console

from rlightning_aio.cli.bench.contender_table import print_contenders
from rlightning_aio.cli.bench.measuring import Contender, Costs, Round, Rule
from rlightning_aio.cli.bench.settings import possible_settings
from rlightning_aio.cli.live_line import fitting
from rlightning_aio.cli.playing.live import Display
from rlightning_aio.config import EnvConfig


def worker(entry: str, owed: list[str], **fields: Any) -> dict[str, Any]:
    known = {"entry": entry, "env_ids": owed, "owed": owed, "owed_seconds": 5.0, "state": "up"}
    return {**known, "pid": None, "restarts": 0, **fields}


def numbers(steps: int, seconds: float) -> dict[str, float]:
    """Those of a group, which has spent three of four seconds in its steps."""
    episodes = {"outcomes_terminated": 3, "outcomes_truncated": 1, "episode_return_mean": 2.5}
    times = {"in_envs": 3 * seconds, "queued": 0.0, "waiting_to_be_collected": 0.0}
    named = {f"seconds_{state}": value for state, value in times.items()}
    waiting = {"seconds_waiting_for_actions": seconds}
    return {f"envs/{k}": v for k, v in {"steps": steps, **episodes, **named, **waiting}.items()}


def display(workers: list[dict[str, Any]], *, idle: float, steps: int = 400) -> Display:
    """The display of a rollout after 10 seconds, with a recent rate of 50 steps/s."""
    group = SimpleNamespace(get_workers=lambda: workers, metrics=lambda: numbers(400, 3))
    statistics = SimpleNamespace(
        steps=steps,
        idle=lambda now: idle,
        elapsed=lambda now: 10.0,
    )
    shown = Display.__new__(Display)
    shown._group, shown._statistics = cast("Any", group), cast("Any", statistics)
    shown._recent = deque([(8.0, numbers(300, 1))])
    shown._steps, shown._seconds, shown._doing, shown._since = 1000, None, "", 0.0
    return shown


def test_the_line_has_the_rate_and_the_time_left() -> None:
    """The most important part is first; parts that don't fit are left out."""
    parts = display([], idle=0.1)._parts(10.0)
    assert parts == [
        "50 steps/s",
        "0:12 left",
        "400 steps",
        "4 episodes ended",
        "return of these 2.50",
        "envs: 75% in steps, 0% queued, 0% to be collected, 25% wait for actions",
    ]
    assert fitting(parts, 32) == "50 steps/s  0:12 left  400 steps"


def test_without_results_the_line_names_the_envs_it_waits_for() -> None:
    """They replace the rate, longest wait first."""
    ids = [f"a-{k}" for k in range(5)]
    workers = [worker("a", ids[1:], owed_seconds=3.0), worker("a", ids[:1], owed_seconds=9.0)]
    parts = display(workers, idle=8.4)._parts(10.0)
    assert parts == ["waiting 8 s for a-0, a-1, a-2 and 2 more", "400 steps"]
    parts = display([worker("robots", [])], idle=3.0)._parts(10.0)
    assert parts[0] == "waiting 3 s for clients of robots"


def test_during_the_start_the_line_names_missing_envs() -> None:
    """Envs of workers that have started are not among them."""
    starting = display([worker("a", ["a-0"], state="starting")], idle=0.0)
    starting._doing, starting._since = "starting 2 envs", 6.0
    assert starting._parts(10.0) == ["starting 2 envs", "waiting 4 s for a-0"]


@pytest.mark.parametrize("width", [60, 80, 120, 160])
def test_a_narrow_terminal_gets_fewer_columns(width: int) -> None:
    """The most important ones stay complete; a note names the others."""
    entry = EnvConfig(name="a", backend="gymnasium", task="CartPole-v1", num_workers=8)
    contenders = [
        Contender(setting, Rule("async, first ready", 1), [Round(1234567.0, (123456.0, 2e6), 9.5)])
        for setting in possible_settings([entry])
    ]
    for contender in contenders:
        contender.costs = Costs(12.0, 3.0, 2**33)
    console = Console(width=width)
    with console.capture() as capture:
        print_contenders(console, "a title", contenders)
    text = capture.get()
    assert max(map(len, text.splitlines())) <= width
    assert text.count("1,234,567") == len(contenders)
    assert "…" not in text
    assert ("too narrow for" in text) == (width < 120)
