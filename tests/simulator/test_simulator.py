"""Random programs do to groups what the model says, and the same seed does the same twice."""

from __future__ import annotations

import hashlib
import logging
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from simulator.coverage import ROWS, row_key, rows
from simulator.program import draw
from simulator.runs import run, run_twice, shown, shrunk
from simulator.world import Faults

from rlightning_aio._core.group.state.episodes import Episodes

if TYPE_CHECKING:
    from collections.abc import Iterator

# A process that is killed as it begins to run a coroutine never awaits it.
pytestmark = pytest.mark.filterwarnings("ignore:coroutine .* was never awaited:RuntimeWarning")

CHUNKS, SEEDS = 5, 15
STORM = Faults(deaths=0.03, stops=0.02, interrupts=0.02, lags=0.02, starts=0.1, fork_servers=0.02)
ROOT = Path(__file__).parents[2]
TRACES = """
import sys
sys.path[:0] = sys.argv[1:]
from simulator.runs import prepare
from simulator.test_simulator import trace_of
prepare()
print(*map(trace_of, range(12)))
"""


def trace_of(seed: int) -> str:
    """A hash of what happens in the world of a program."""
    return hashlib.sha256("\n".join(run(draw(seed)).trace).encode()).hexdigest()


@pytest.fixture(autouse=True)
def without_logs() -> Iterator[None]:
    """Deaths would fill them."""
    log = logging.getLogger("rlightning_aio")
    level = log.level
    log.setLevel(logging.CRITICAL)
    yield
    log.setLevel(level)


@pytest.mark.parametrize("chunk", range(CHUNKS))
def test_programs_do_what_the_model_says(chunk: int) -> None:
    """In a world, with faults; `make simulate` runs more of them."""
    for seed in range(chunk * SEEDS, (chunk + 1) * SEEDS):
        program = draw(seed)
        found = run_twice(program) if seed % 5 == 0 else run(program)
        assert not found.error, shown(shrunk(found, run_twice))


def test_groups_survive_every_kind_of_fault() -> None:
    programs = [replace(draw(seed), faults=STORM) for seed in range(40)]
    runs = [run(one) for one in programs if one.kind == "group" and "async" not in one.features]
    assert not [shown(found) for found in runs if found.error]
    counts = sum((found.counts for found in runs), Counter[str]())
    assert counts.keys() >= {"deaths", "stops", "interrupts", "lags", "slow starts", "refusals"}


def test_the_same_happens_in_another_folder(tmp_path: Path) -> None:
    """Envs raise errors, whose tracebacks name files; another process has another pid."""
    folder = tmp_path / "a folder of another length"
    for path in ("src/rlightning_aio", "tests/simulator", "tests/kit"):
        shutil.copytree(ROOT / path, folder / path, ignore=shutil.ignore_patterns("__pycache__"))
    here, there = (
        subprocess.run(
            [sys.executable, "-c", TRACES, str(root / "src"), str(root / "tests")],
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        ).stdout.split()
        for root in (ROOT, folder)
    )
    assert len(here) == 12
    assert here == there


def test_a_defect_is_found_and_shrunk(monkeypatch: pytest.MonkeyPatch) -> None:
    """A group that forgets to report the step limit is found soon, by few operations."""
    original = Episodes.returned

    def forgetful(self: Episodes, slots: Any, flagged: Any) -> Any:
        original(self, slots, flagged)

    monkeypatch.setattr(Episodes, "returned", forgetful)
    runs = (run(draw(seed)) for seed in range(200))
    failed = next(found for found in runs if "limit_reached" in (found.error or ""))
    small = shrunk(failed, run)
    assert len(small.program.ops) <= 10
    assert small.kind == failed.kind


def test_every_row_of_the_page_of_faults_is_known() -> None:
    keys = [row_key(row) for row in rows()]
    assert len(set(keys)) == len(keys) == len(ROWS)
