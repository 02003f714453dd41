"""Ctrl-C and errors in groups under RLightning's names: the group stays usable."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import pytest

from rlightning_aio.errors import BadAction, EnvRaised
from rlightning_aio.plugins.legacy.names import is_rlightning_installed, make_importable

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from rlightning.env.env_group import EnvGroup

if is_rlightning_installed():
    pytest.skip("RLightning itself is installed", allow_module_level=True)
make_importable()

from legacy.test_group import entry, responses  # noqa: E402
from rlightning.types import BatchedData  # noqa: E402
from rlightning.utils.builders import build_env_group  # noqa: E402

LIMIT = 3


@pytest.fixture
def group() -> Iterator[EnvGroup]:
    """Two envs in two workers."""
    group = build_env_group(entry("interrupting", num_workers=2, max_episode_steps=LIMIT))
    yield group
    group.close()


def counts(batch: Any) -> dict[int, float]:
    """Return the steps that each env has counted, by its index."""
    return {int(ret.observation[0]): ret.observation[1] for ret in batch.values()}


def interrupt(group: EnvGroup, folder: Path, run: Any) -> None:
    """Have `run` interrupted by env 1 while that executes a request."""
    go_on = folder / "go-on"
    group.env_list[1].interrupt_next(os.getpid(), str(go_on))
    with pytest.raises(KeyboardInterrupt):
        run()
    go_on.touch()


def test_a_reset_drops_what_an_interrupted_call_has_left_in_flight(
    group: EnvGroup, tmp_path: Path
) -> None:
    ids = group.env_ids
    interrupt(group, tmp_path, group.reset)
    assert counts(group.reset()[0]) == {0: 0, 1: 0}
    interrupt(group, tmp_path, lambda: group.step(responses(ids)))
    assert counts(group.reset()[0]) == {0: 0, 1: 0}
    assert not len(group.collect_async()[0])
    assert counts(group.step(responses(ids))[0]) == {0: 1, 1: 1}


def test_an_interrupted_step_can_be_collected(group: EnvGroup, tmp_path: Path) -> None:
    group.reset()
    interrupt(group, tmp_path, lambda: group.step(responses(group.env_ids)))
    assert counts(group.collect_async(wait_all=True)[0]) == {0: 1, 1: 1}


def test_an_interrupted_call_drops_its_values(group: EnvGroup, tmp_path: Path) -> None:
    """It ends in the envs."""
    group.reset()
    interrupt(group, tmp_path, group.apply_evaluate_cfg)
    assert counts(group.reset()[0]) == {0: 0, 1: 0}
    assert [env.evaluates for env in group.env_list] == [True, True]


def test_a_refused_step_resets_nothing(group: EnvGroup) -> None:
    ids = group.env_ids
    with group.auto_reset(LIMIT):
        group.reset()
        for _ in range(LIMIT):
            _, flags = group.step(responses(ids[:1]))
        assert flags == [True]
        good = responses(ids[:1])[ids[0]]
        with pytest.raises(AttributeError):
            group.step(BatchedData(ids, [good, "text"]))
        unpicklable = responses(ids[1:], action=(number for number in ()))[ids[1]]
        with pytest.raises(BadAction, match="nothing was sent"):
            group.step(BatchedData(ids, [good, unpicklable]))
        assert counts(group.step(responses(ids))[0]) == {0: 0, 1: 1}
        assert not len(group.collect_async()[0])


def test_a_reset_with_an_error_resets_the_counts_of_the_others(group: EnvGroup) -> None:
    """The error has their results, under RLightning's ids."""
    ids = group.env_ids
    with group.auto_reset(LIMIT):
        group.reset()
        group.step(responses(ids))
        with pytest.raises(EnvRaised, match="as asked") as caught:
            group.reset(fails=1)
        assert caught.value.env_id == ids[1]
        assert caught.value.results.ids() == (ids[0],)
        flags = [group.step(responses(ids[:1]))[1] for _ in range(LIMIT)]
        assert flags == [[False], [False], [True]]
