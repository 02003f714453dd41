"""Ctrl-C and errors in groups under RLightning's names: nothing is lost, and envs stay usable."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import pytest

from rlightning_aio.errors import BadAction, EnvRaised
from rlightning_aio.plugins.legacy.names import is_rlightning_installed, names_in_use

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from rlightning.env.env_group import EnvGroup

if is_rlightning_installed():
    pytest.skip("RLightning itself is installed", allow_module_level=True)
names_in_use()

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


def mixed(ids: Any, *wants: str | None) -> BatchedData:
    values = [
        responses([env_id], wants=want)[env_id] for env_id, want in zip(ids, wants, strict=True)
    ]
    return BatchedData(ids, values)


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


def test_a_reset_that_is_interrupted_is_collected(group: EnvGroup, tmp_path: Path) -> None:
    interrupt(group, tmp_path, group.reset)
    batch, _ = group.collect_async(wait_all=True)
    assert counts(batch) == {0: 0, 1: 0}
    assert counts(group.reset()[0]) == {0: 0, 1: 0}
    assert counts(group.step(responses(group.env_ids))[0]) == {0: 1, 1: 1}


@pytest.mark.parametrize("collects", [False, True])
def test_a_call_that_is_interrupted_ends_later(
    group: EnvGroup, tmp_path: Path, collects: bool
) -> None:
    """Its values are dropped."""
    group.reset()
    interrupt(group, tmp_path, group.apply_evaluate_cfg)
    if collects:
        assert not len(group.collect_async()[0])
    assert [env.evaluates for env in group.env_list] == [True, True]
    assert counts(group.step(responses(group.env_ids))[0]) == {0: 1, 1: 1}


def test_an_error_outlives_an_interrupted_step(
    group: EnvGroup, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C comes after the error of one env, and before the result of the other."""
    group.reset()
    core: Any = group._group._core
    collect, found = core.collect_async, iter([True])

    def collect_once(**how: Any) -> Any:
        if next(found, False):
            return collect(**how)
        raise KeyboardInterrupt

    with monkeypatch.context() as patches:
        patches.setattr(core, "collect_async", collect_once)
        with pytest.raises(KeyboardInterrupt):
            group.step(mixed(group.env_ids, "an error", None))
    with pytest.raises(EnvRaised, match="as asked") as caught:
        group.collect_async(wait_all=True)
    assert caught.value.env_id == group.env_ids[0]
    assert counts(group.collect_async(wait_all=True)[0]) == {1: 1}


def test_an_interrupted_step_counts(group: EnvGroup, tmp_path: Path) -> None:
    """When its result has arrived, whenever that is returned."""
    ids = group.env_ids
    with group.auto_reset(LIMIT):
        group.reset()
        group.step(responses(ids))
        interrupt(group, tmp_path, lambda: group.step(responses(ids)))
        batch, flags = group.step(responses(ids))
        assert (counts(batch), flags) == ({0: 3, 1: 3}, [True, True])
        batch, flags = group.step(responses(ids))
        assert (counts(batch), flags) == ({0: 0, 1: 0}, [False, False])
        batch, flags = group.collect_async()
        assert (counts(batch), flags) == ({0: 2, 1: 2}, [False, False])


def test_results_of_before_count_at_most_to_the_limit(group: EnvGroup) -> None:
    """However many were not collected when counting begins."""
    ids = group.env_ids
    group.reset()
    for _ in range(LIMIT + 3):
        group.step_async(responses(ids))
    with group.auto_reset(LIMIT):
        assert counts(group.step(responses(ids))[0]) == {0: 0, 1: 0}
    assert group.step(responses(ids))[1] is None


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
