"""Commands with awaitable envs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from cli.command import invoke, invoke_json, write_config

from rlightning_aio.cli import settings
from rlightning_aio.config import load_config
from rlightning_aio.spaces import Anything

if TYPE_CHECKING:
    from pathlib import Path


class Talk:
    observation_space = action_space = Anything()

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return "hello", {}

    async def step(self, action: Any) -> Any:
        raise AssertionError


TALK: dict[str, Any] = {"name": "t", "backend": "callable", "task": "cli.test_awaitable:Talk"}


def test_check_steps_no_env_whose_actions_only_a_policy_can_choose(tmp_path: Path) -> None:
    config = write_config(tmp_path, {**TALK, "placement": "loop"})
    lines = invoke("check", config).stdout.splitlines()
    assert lines[-1] == "  reset; not stepped: only a policy can choose its actions"
    (entry,) = invoke_json("check", config)["entries"]
    assert (entry["action_space"], entry["steps"]) == ("Anything()", 0)


TRIED: list[tuple[list[dict[str, Any]], list[tuple[str, int]]]] = [
    ([{}], [("loop", 0), ("process", 1), ("process", 2), ("process", 4)]),
    # Workers have no such limit.
    ([{"max_concurrency": 2}], [("loop", 0)]),
    # Envs that are not awaitable need workers.
    ([{}, {"placement": "process"}], [("process", 2), ("process", 4), ("process", 8)]),
]


@pytest.mark.parametrize(("fields", "tried"), TRIED, ids=["alone", "limited", "beside others"])
def test_bench_tries_the_event_loop_and_workers(
    fields: list[dict[str, Any]],
    tried: list[tuple[str, int]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(settings, "num_cores", lambda: 2)
    both = {**TALK, "placement": "loop", "num_workers": 4}
    entries = [{**both, "name": f"t{k}", **own} for k, own in enumerate(fields)]
    found = settings.possible_settings(load_config(write_config(tmp_path, *entries), ()))
    assert [(setting.placement, setting.workers) for setting in found] == tried
