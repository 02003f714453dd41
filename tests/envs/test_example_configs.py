"""The examples in configs/ whose simulators run in one environment, from the command line.

Those of Isaac Lab and Piper are with the tests of their backends.
"""

from __future__ import annotations

import pytest
from envs.closing_table import closing_table, steps

pytestmark = [
    pytest.mark.simulators,
    pytest.mark.timeout(300),  # Importing ManiSkill alone takes seconds.
]


@pytest.mark.parametrize(
    ("name", "simulator"), [("ale", "ale_py"), ("maniskill", "mani_skill"), ("pettingzoo", "mpe2")]
)
def test_the_example_ends_with_its_table(name: str, simulator: str) -> None:
    """It runs unchanged, and its closing table has the steps of its entry."""
    pytest.importorskip(simulator)
    assert steps(closing_table(name, "--steps", "400")["steps"]) >= 400
