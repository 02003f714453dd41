"""What does a timeline cost while it is recorded (`group.trace`)?

A group is stepped alternately with a trace and without, for a moment each, so differences between
groups and between moments affect both alike. A control has the same turns and records nothing. The
file is written at the end of a recording, between the turns.
"""

from __future__ import annotations

import tempfile
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from contenders import OursAsync, OursSync, Work
from harness import Contender, Question, Target, main

CHEETAHS = Work("HalfCheetah-v5", num_envs=32, backend="mujoco")
POLES = Work("CartPole-v1", num_envs=64)
RATE = 0.97
TURNS = 16


class _ByTurns:
    """The median of one moment's rate divided by that of the moment next to it."""

    traced = False
    _envs: Any

    def round(self, seconds: float) -> float:
        """Run `TURNS` pairs of moments; every other pair begins with the second."""
        with tempfile.TemporaryDirectory() as folder:
            ratios: list[float] = []
            for turn in range(TURNS):
                rates = [0.0, 0.0]
                for second in (0, 1) if turn % 2 else (1, 0):
                    with self._recording(folder) if second else nullcontext():
                        rates[second] = super().round(seconds / 2 / TURNS)  # type: ignore[misc]
                ratios.append(rates[1] / rates[0])
        return median(ratios)

    def _recording(self, folder: str) -> AbstractContextManager[Any]:
        return self._envs.trace(Path(folder) / "run.json") if self.traced else nullcontext()


@dataclass
class SyncByTurns(_ByTurns, OursSync):
    """See `_ByTurns`."""

    traced: bool = False


@dataclass
class AsyncByTurns(_ByTurns, OursAsync):
    """See `_ByTurns`."""

    traced: bool = False


def _pairs() -> list[tuple[Contender, Contender]]:
    """Return each group's contenders: the control, and the one with a trace."""
    pairs: list[tuple[Contender, Contender]] = []
    for work, name in ((CHEETAHS, "HalfCheetah x 32"), (POLES, "CartPole x 64")):
        half = work.num_envs // 2
        names = f"sync, {name}", f"async half, {name}"
        pairs += [
            (SyncByTurns(names[0], work), SyncByTurns(f"traced {names[0]}", work, traced=True)),
            (
                AsyncByTurns(names[1], work, min_results=half),
                AsyncByTurns(f"traced {names[1]}", work, min_results=half, traced=True),
            ),
        ]
    return pairs


PAIRS = _pairs()
QUESTION = Question(
    name="tracing",
    title="Rate with a timeline recorded over the rate without, in the same group",
    unit="ratio",
    contenders=[contender for pair in PAIRS for contender in pair],
    targets=[Target(traced.name, plain.name, RATE) for plain, traced in PAIRS],
    rounds=5,
    seconds=1.5,
    counts_steps=False,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
