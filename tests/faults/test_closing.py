"""How long envs may take to close, and what becomes of those that take longer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from faults.closing import IMPORTS, closed_in
from patience import HANG

import rlightning_aio as rl

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.one_driver_for_each_place
AWAITABLE, PLAIN = "closing, awaitable", "closing"
PLACES = {
    "loop": {"backend": AWAITABLE, "placement": "loop"},
    "awaiting worker": {"backend": AWAITABLE, "envs_per_process": 3},
    "worker": {"backend": PLAIN, "envs_per_process": 3},
}
LONGER = {AWAITABLE: 0.8, PLAIN: 1.7}
"""Seconds that are more than envs have without a `close_timeout`."""


def entry(place: str, folder: Path, **fields: Any) -> dict[str, Any]:
    kwargs = {"folder": str(folder), **fields.pop("env_kwargs", {})}
    fields = {"name": "e", "num_workers": 3, **IMPORTS, **PLACES[place], **fields}
    return {**fields, "env_kwargs": kwargs}


@pytest.mark.parametrize("place", PLACES)
async def test_envs_may_take_as_long_to_close_as_their_entry_says(
    place: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    seconds = LONGER[str(PLACES[place]["backend"])]
    if place == "worker":
        seconds /= 3  # They close one after the other.
    config = entry(place, tmp_path, close_timeout=HANG, env_kwargs={"seconds": seconds})
    async with rl.build_env_group(config) as group:
        await group.reset()
    assert closed_in(tmp_path) == ["e-0", "e-1", "e-2"]
    assert "closed" not in caplog.text


@pytest.mark.parametrize("close_timeout", [None, 0.2])
@pytest.mark.parametrize("place", PLACES)
async def test_envs_that_could_not_be_closed_are_named_in_the_log(
    place: str, close_timeout: float | None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Those of a worker of plain envs that come after the one that hangs were not closed, too."""
    config = entry(place, tmp_path, close_timeout=close_timeout, env_kwargs={"hangs": 1})
    group = rl.build_env_group(config)
    await group.init()
    with pytest.warns(UserWarning, match=r"close\(\) of env 'e-1' raised"):
        await group.close()
    closed = closed_in(tmp_path)
    (line,) = [r.getMessage() for r in caplog.records if "not closed" in r.getMessage()]
    assert {env_id for env_id in group.env_ids if env_id in line} == {*group.env_ids} - {*closed}
    assert closed == (["e-0"] if place == "worker" else ["e-0", "e-2"])
    assert "close_timeout" in line


async def test_an_entry_that_closes_quickly_does_not_wait_for_another(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Each has its own limit."""
    quick = entry("worker", tmp_path, close_timeout=0.1, env_kwargs={"hangs": 0}) | {"name": "q"}
    slow = entry("worker", tmp_path, close_timeout=HANG, env_kwargs={"seconds": 0.5})
    group = rl.build_env_group([quick, slow])
    await group.init()
    with pytest.warns(UserWarning, match=r"'q-0'.*did not close in time and was killed"):
        await group.close()
    assert closed_in(tmp_path) == ["e-0", "e-1", "e-2"]
    assert "q-0, q-1, q-2" in caplog.text
