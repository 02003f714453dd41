"""Every feature that runs on top of a group whose envs are in actors, for each kind of env."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import pytest
from combinations.features import FEATURES
from combinations.options import Options, Use
from combinations.played import KINDS

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.ray

# Whether observations are views, the limit, how many results a collect takes, and the driver.
_TURNS = itertools.cycle([(True, math.inf, (1, None), False), (False, 4, (2, 2), True)])
CHOSEN = [
    Options(kind, "ray", zero_copy, "uneven", limit, None, results, is_async)
    for kind, (zero_copy, limit, results, is_async) in zip(KINDS, _TURNS, strict=False)
]


@pytest.mark.parametrize("options", CHOSEN, ids=str)
def test_features_on_actors(options: Options, tmp_path: Path) -> None:
    """Each is compared with plain envs that are stepped in a loop, one list for each."""
    with Use(options) as use:
        for feature in FEATURES:
            folder = tmp_path / feature.__name__
            folder.mkdir()
            feature(use, folder)
            use.drain()
