"""Ctrl-C and errors in groups under RLightning's names: the group stays usable."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from faults.striking import struck

from rlightning_aio.errors import BadAction, EnvRaised
from rlightning_aio.plugins.legacy.names import is_rlightning_installed, make_importable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rlightning.env.env_group import EnvGroup

if is_rlightning_installed():
    pytest.skip("RLightning itself is installed", allow_module_level=True)
make_importable()

from legacy.test_group import entry, responses  # noqa: E402
from rlightning.types import BatchedData  # noqa: E402
from rlightning.utils.builders import build_env_group  # noqa: E402

LIMIT = 3
STRIDE = 61
"""Every so many lines, Ctrl-C is pressed."""
NUM_LINES = 9000
"""More lines than any of the calls below executes."""


@pytest.fixture
def group() -> Iterator[EnvGroup]:
    """Two envs in two workers."""
    group = build_env_group(entry("failing", num_workers=2, max_episode_steps=LIMIT))
    yield group
    group.close()


def counts(batch: Any) -> dict[int, float]:
    """Return the steps that each env has counted, by its index."""
    return {int(ret.observation[0]): ret.observation[1] for ret in batch.values()}


USES: dict[str, Callable[[EnvGroup], Any]] = {
    "step": lambda group: group.step(responses(group.env_ids)),
    "reset": lambda group: group.reset(),
    "call": lambda group: group.apply_evaluate_cfg(),
}


@pytest.mark.usefixtures("pressed_again")
@pytest.mark.parametrize("use", USES)
def test_a_reset_goes_on_wherever_a_call_was_interrupted(group: EnvGroup, use: str) -> None:
    """What was left in flight can be collected; a reset drops it."""
    group.reset()
    for number, line in enumerate(range(1, NUM_LINES, STRIDE)):
        reached, _, _ = struck(line, lambda: USES[use](group))
        if number % 2:
            assert len(group.collect_async(wait_all=True)[0]) in (0, 2)
        assert counts(group.reset()[0]) == {0: 0, 1: 0}
        assert not len(group.collect_async()[0])
        assert counts(group.step(responses(group.env_ids))[0]) == {0: 1, 1: 1}
        if not reached:
            break
    else:
        pytest.fail(f"a call executes more than {NUM_LINES} lines")
    assert [env.evaluates for env in group.env_list] == [use == "call"] * 2


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
