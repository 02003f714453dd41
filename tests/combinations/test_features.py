"""Every feature that runs on top of a group, over the options that a group has.

Each is compared with plain envs that are stepped in a loop, one list for each.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from combinations.features import FEATURES
from combinations.options import FACTORS, Options, Use, pairwise
from hypothesis import given
from hypothesis import strategies as st

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path


@pytest.fixture(scope="module", params=pairwise(Options, FACTORS), ids=str)
def use(request: pytest.FixtureRequest) -> Iterator[Use]:
    """One group for all features."""
    with Use(request.param) as made:
        yield made


@pytest.mark.parametrize("feature", FEATURES, ids=lambda feature: feature.__name__)
def test_each_pair_of_options(
    use: Use, feature: Callable[[Use, Path], None], tmp_path: Path
) -> None:
    """In workers, in this process, and in both."""
    try:
        feature(use, tmp_path)
    finally:
        use.drain()


# Workers take seconds to start on a busy machine.
_INLINE = {**FACTORS, "placement": ["inline"]}
_OPTIONS = st.builds(Options, **{name: st.sampled_from(values) for name, values in _INLINE.items()})


@given(_OPTIONS.filter(lambda options: options.fits), st.data())
def test_any_options(tmp_path_factory: pytest.TempPathFactory, options: Any, data: Any) -> None:
    """One feature after another with the same envs, in any order."""
    with Use(options) as use:
        for feature in data.draw(st.permutations(FEATURES))[:3]:
            feature(use, tmp_path_factory.mktemp("run"))
            use.drain()
