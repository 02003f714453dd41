"""Ctrl-C at any moment of a call under RLightning's names takes no result from the program."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import pytest
from faults.striking import hear_of_interrupt, struck

from rlightning_aio.plugins.legacy.names import is_rlightning_installed, names_in_use

if TYPE_CHECKING:
    from collections.abc import Callable

if is_rlightning_installed():
    pytest.skip("RLightning itself is installed", allow_module_level=True)
names_in_use()

from legacy.test_group import entry, responses  # noqa: E402
from rlightning.utils.builders import build_env_group  # noqa: E402

pytestmark = pytest.mark.usefixtures("python_raises")
STRIDE = int(os.environ.get("RLIGHTNING_AIO_STRIDE", "37"))
"""Every so many lines, Ctrl-C is pressed; 1 takes minutes."""
NUM_LINES = 9000
"""More lines than any of the calls below executes."""


def step(group: Any) -> Any:
    return group.step(responses(group.env_ids))


def step_async(group: Any) -> Any:
    group.step_async(responses(group.env_ids))
    return group.collect_async(wait_all=True)


def first_ready(group: Any) -> Any:
    group.step_async(responses(group.env_ids))
    return group.collect_async()


@pytest.mark.parametrize("use", [step, step_async, first_ready], ids=lambda use: use.__name__)
def test_no_step_is_lost_wherever_a_call_is_interrupted(use: Callable[[Any], Any]) -> None:
    """What the interrupted call doesn't return comes through `collect_async`."""
    group: Any = build_env_group(entry("counting", num_workers=3, envs_per_process=2))
    try:
        group.reset()
        seen = dict.fromkeys(group.env_ids, 0.0)

        def take(found: tuple[Any, list[bool]]) -> None:
            for env_id, ret in found[0].items():
                assert ret.observation[1] == seen[env_id] + 1
                seen[env_id] += 1

        for line in range(1, NUM_LINES, STRIDE):
            reached, interrupted, found = struck(line, lambda: use(group))
            if found is not None:
                take(found)
            if reached and not interrupted:
                hear_of_interrupt(group.collect_async)
            take(group.collect_async(wait_all=True))
            if not reached:
                break
        else:
            pytest.fail(f"a call executes more than {NUM_LINES} lines")
        take(step(group))
    finally:
        group.close()
