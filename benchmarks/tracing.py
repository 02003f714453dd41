"""What does a timeline cost while it is recorded (`group.trace`)?

The same groups with a trace running and without. The file is written when the recording ends; that
is no part of the rate.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from contenders import OursAsync, OursSync, Work
from harness import Contender, Question, Target, main

CHEETAHS = Work("HalfCheetah-v5", num_envs=32, backend="mujoco")
POLES = Work("CartPole-v1", num_envs=64)
RATE = 0.97


class _Traced:
    """A round is recorded from its beginning to its end."""

    _envs: Any

    def round(self, seconds: float) -> float:
        with tempfile.TemporaryDirectory() as folder, self._envs.trace(Path(folder) / "run.json"):
            return super().round(seconds)  # type: ignore[misc]


@dataclass
class TracedSync(_Traced, OursSync):
    """See `_Traced`."""


@dataclass
class TracedAsync(_Traced, OursAsync):
    """See `_Traced`."""


def _pairs() -> list[tuple[Contender, Contender]]:
    """Each group without a trace, and with one."""
    pairs: list[tuple[Contender, Contender]] = []
    for work, name in ((CHEETAHS, "HalfCheetah x 32"), (POLES, "CartPole x 64")):
        half = work.num_envs // 2
        pairs += [
            (OursSync(f"sync, {name}", work), TracedSync(f"traced sync, {name}", work)),
            (
                OursAsync(f"async half, {name}", work, min_results=half),
                TracedAsync(f"traced async half, {name}", work, min_results=half),
            ),
        ]
    return pairs


PAIRS = _pairs()
QUESTION = Question(
    name="tracing",
    title="With a timeline recorded and without",
    unit="env steps/s",
    contenders=[contender for pair in PAIRS for contender in pair],
    targets=[Target(traced.name, plain.name, RATE) for plain, traced in PAIRS],
    rounds=15,
    seconds=1.0,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
