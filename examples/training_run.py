"""Shared code of the training examples: arguments, progress, the curve, checkpoints, Ctrl-C.

Not an example itself. Nothing here depends on environments or an algorithm.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import signal
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar, get_type_hints

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

try:
    from torch.utils.tensorboard import SummaryWriter
except ImportError:  # TensorBoard isn't installed.
    SummaryWriter = None

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

T = TypeVar("T")

# Networks of this size gain nothing from more threads, and environments need the other cores.
torch.set_num_threads(1)
# Arguments of distributions come from networks; checking them takes as long as using them.
torch.distributions.Distribution.set_default_validate_args(False)


def arguments(*presets: type[T]) -> T:
    """Parse arguments into a dataclass; `--task` selects the preset of that task."""
    chosen = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    chosen.add_argument("--task", default=presets[0]().task)  # type: ignore[attr-defined]
    task = chosen.parse_known_args()[0].task
    preset = next((p for p in presets if p().task == task), presets[0])  # type: ignore[attr-defined]
    parser = argparse.ArgumentParser(
        description=sys.modules["__main__"].__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    kinds = get_type_hints(preset)
    for field in dataclasses.fields(preset):  # type: ignore[arg-type]
        kind: Any = kinds[field.name]
        how = {"action": argparse.BooleanOptionalAction} if kind is bool else {"type": kind}
        option = f"--{field.name.replace('_', '-')}"
        parser.add_argument(option, default=field.default, help=f"default: {field.default}", **how)
    return preset(**vars(parser.parse_args()))


def tensors(arrays: dict[str, Any]) -> dict[str, torch.Tensor]:
    """Convert arrays to tensors, which a checkpoint may contain."""
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


class Run:
    """One training run: progress, results, and files.

    Args:
        total_steps: transitions after which it ends.
        folder: of ``curve.csv``, ``checkpoint.pt`` and TensorBoard's files; the name of the
            example and the seed say whose they are.
        resume: go on from the checkpoint in `folder`.

    Attributes:
        steps: transitions so far.
        saved: what the checkpoint held, where there is one to go on from.
        rows: the curve, one dict for each `record`.

    The first Ctrl-C lets the update end and then the run, which saves itself; the second one
    interrupts at once.
    """

    def __init__(self, total_steps: int, folder: str, resume: bool = False) -> None:
        self.total_steps = total_steps
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.steps, self.rows, self.saved = 0, list[dict[str, float]](), dict[str, Any]()
        self._spent, self._learned, self._stopped = 0.0, 0.0, False
        self._returns: list[float] = []
        if resume:
            # `save` writes only tensors and plain containers, so loading runs no code.
            self.saved = torch.load(self.folder / "checkpoint.pt", weights_only=True)
            run = self.saved["run"]
            self.steps, self.rows, self._returns = run["steps"], run["rows"], run["returns"]
            self._spent, self._learned = run["seconds"], run["learner_seconds"]
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        console = Console(stderr=True)
        self._bar = Progress(
            *columns, TimeRemainingColumn(), console=console, disable=not console.is_terminal
        )
        self._writer = SummaryWriter(str(self.folder)) if SummaryWriter else None

    def __enter__(self) -> Self:
        self._began = time.perf_counter() - self._spent
        self._before = signal.signal(signal.SIGINT, self._stop)
        self._bar.start()
        self._task = self._bar.add_task("training", total=self.total_steps, completed=self.steps)
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()
        signal.signal(signal.SIGINT, self._before)
        if self._writer:
            self._writer.close()

    def _stop(self, *_: object) -> None:
        self._stopped = True
        signal.signal(signal.SIGINT, self._before)

    def goes_on(self) -> bool:
        """True until the run is complete or interrupted."""
        return self.steps < self.total_steps and not self._stopped

    @property
    def remaining(self) -> float:
        """Remaining share of the run, from 1 to 0; learning rates are proportional to it."""
        return 1.0 - self.steps / self.total_steps

    @contextmanager
    def learning(self) -> Iterator[None]:
        """Context that measures the time of learning."""
        began = time.perf_counter()
        yield
        self._learned += time.perf_counter() - began

    def record(self, steps: int, returns: Sequence[float], **figures: float) -> None:
        """Record the end of an update: a row of the curve.

        Args:
            steps: transitions since the last one.
            returns: of the episodes that have ended since.
            figures: what else to keep.
        """
        self.steps += steps
        self._returns = [*self._returns, *map(float, returns)][-100:]
        mean = sum(self._returns) / len(self._returns) if self._returns else float("nan")
        row = {
            "steps": self.steps,
            "seconds": time.perf_counter() - self._began,
            "learner_seconds": self._learned,
            "return": mean,
            **{name: float(value) for name, value in figures.items()},
        }
        self.rows.append(row)
        self._bar.update(
            self._task, completed=self.steps, description=f"return of 100 episodes {mean:.1f}"
        )
        if self._writer:
            for name, value in row.items():
                self._writer.add_scalar(name, value, self.steps)

    def save(self, state: dict[str, Any]) -> None:
        """Write the checkpoint and the curve atomically."""
        run = {
            "steps": self.steps,
            "rows": self.rows,
            "returns": self._returns,
            "seconds": time.perf_counter() - self._began,
            "learner_seconds": self._learned,
        }
        written = self.folder / "checkpoint.pt.new"
        torch.save({**state, "run": run}, written)
        written.replace(self.folder / "checkpoint.pt")
        with (self.folder / "curve.csv").open("w", newline="") as file:
            table = csv.DictWriter(file, list(self.rows[0]) if self.rows else [])
            table.writeheader()
            table.writerows(self.rows)
