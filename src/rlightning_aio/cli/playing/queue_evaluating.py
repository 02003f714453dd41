"""``rlightning-aio eval`` with a queue: each episode once, on any free env, figures by task."""

from __future__ import annotations

import contextlib
import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import typer
from rich.live import Live

import rlightning_aio
from rlightning_aio.cli.bench.plots import check_plot, draw_evaluation
from rlightning_aio.cli.figures import estimates, with_interval
from rlightning_aio.cli.option_files import naming_option
from rlightning_aio.cli.playing.evaluation_file import queue_subject
from rlightning_aio.cli.playing.films import rendering
from rlightning_aio.cli.policies.collecting import playing
from rlightning_aio.cli.terminal import (
    count,
    counted,
    err,
    named_columns,
    number,
    out,
    print_json,
    print_table,
    run_interruptible,
)
from rlightning_aio.errors import ConfigError
from rlightning_aio.evaluation import EpisodeRecord, QueueEvaluation, ResultsFile, evaluate
from rlightning_aio.files import check_folder

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.table import Table

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.attempts.spec import EpisodeKey
    from rlightning_aio.cli.playing.queue_options import QueueOptions
    from rlightning_aio.cli.policies.policies import Policy
    from rlightning_aio.config import EnvConfig
    from rlightning_aio.evaluation import EpisodeSpec, EpisodeVideo

__all__ = ["QueueOrder", "evaluate_queue"]

_NAMED: Final = 5
"""Number of failed episodes that a message names."""


@dataclass(frozen=True)
class QueueOrder:
    """The other options of the command.

    Attributes:
        named: a text that identifies the policy.
        facts: what the command was given, for the report.
    """

    policy: Policy | None
    named: str
    resume: Path | None
    plot: Path | None
    trace: Path | None
    as_json: bool
    facts: dict[str, Any]


def evaluate_queue(configs: Sequence[EnvConfig], options: QueueOptions, order: QueueOrder) -> None:
    """Play the episodes that `options` ask for, and print the results by task."""
    check_plot(order.plot)
    specs = options.specs(configs)
    video = options.films(specs)
    if video is not None:
        with naming_option("--video", Path(video.folder)):
            check_folder(video.folder)
    about = queue_subject(configs, order.named)
    if video is not None:
        configs = [rendering(config) for config in configs]
    with contextlib.ExitStack() as stack:
        results = None
        if order.resume is not None:
            results = stack.enter_context(ResultsFile(order.resume, about, label="--resume"))
        group = rlightning_aio.build_env_group(configs, mixed_actions=True)
        watch = stack.enter_context(_Watch(len(group), specs, results))
        play = _Play(group, configs, specs, options.max_attempts, video, results, watch)
        interrupted, stopped = True, False
        try:
            run_interruptible(_evaluate(play, order))
            interrupted = False
        except KeyboardInterrupt:
            stopped = True
            raise
        finally:
            # After an error, too: the episodes until then may be useful.
            watch.stop()
            if stopped or watch.found.records:
                facts = {**order.facts, "queue": len(specs), "interrupted": interrupted}
                _report(facts, watch.found, order)
    if watch.found.failed:
        raise typer.Exit(1)


@dataclass(frozen=True)
class _Play:
    group: EnvGroup
    configs: Sequence[EnvConfig]
    specs: Sequence[EpisodeSpec]
    max_attempts: int
    video: EpisodeVideo | None
    results: ResultsFile | None
    watch: _Watch


async def _evaluate(play: _Play, order: QueueOrder) -> None:
    group, watch = play.group, play.watch
    async with playing(group, order.policy, None, order.trace, watch.draw) as policy:
        watch.ready()
        try:
            evaluated = evaluate(
                group,
                policy,
                play.specs,
                max_attempts=play.max_attempts,
                results=play.results,
                video=play.video,
                on_episode=watch.note,
            )
        except ValueError as error:
            raise ConfigError(str(error)) from None
        watch.found = await evaluated


class _Watch:
    """The episodes so far, and the live table on stderr."""

    def __init__(
        self, num_envs: int, specs: Sequence[EpisodeSpec], results: ResultsFile | None
    ) -> None:
        played = [] if results is None else results.played
        wanted = {spec.key for spec in specs}
        self.found = QueueEvaluation([one for one in played if not wanted.isdisjoint(_keys(one))])
        self._total = len(specs)
        self._begun, self._before = time.monotonic(), len(self.found.records)
        self._console = err()
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._starting = f"starting {counted(num_envs, 'env')}"
        self._recent: dict[str, None] = {}
        """Tasks in the order of their last episodes."""

    def __enter__(self) -> Self:
        self._console.print(self._starting)
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End the live table."""
        if self._console.is_terminal:
            self._live.stop()

    def ready(self) -> None:
        """Show that all envs have started, with the number of episodes."""
        self._begun = time.monotonic()
        before = f", {count(self._before)} of them played before" if self._before else ""
        self._console.print(f"playing {counted(self._total, 'episode')}{before}")

    def note(self, record: EpisodeRecord) -> None:
        """Count a finished episode."""
        self.found.records.append(record)
        self._recent.pop(record.task, None)
        self._recent[record.task] = None

    def draw(self) -> None:
        """Draw the live table, with the tasks that had the last episodes if there are many."""
        if not self._console.is_terminal:
            return
        done = len(self.found.records)
        new = done - self._before
        seconds = time.monotonic() - self._begun
        left = f", {(self._total - done) * seconds / new:,.0f} s left" if new else ""
        by_task = self.found.by_task()
        rows = max(4, self._console.height - 6)
        recent = {task: by_task[task] for task in by_task if task in [*self._recent][-rows:]}
        title = f"{count(done)} of {counted(self._total, 'episode')}{left}"
        self._live.update(_table(title, recent, self.found), refresh=True)


def _keys(record: EpisodeRecord) -> set[EpisodeKey]:
    """Return the keys that an episode may have before its entry and task are filled in."""
    entry, task, seed, options = record.key
    return {(one, other, seed, options) for one in ("", entry) for other in ("", task)}


# -- output ------------------------------------------------------------------------------


def _table(title: str, by_task: dict[str, QueueEvaluation], found: QueueEvaluation) -> Table:
    table = named_columns(
        title, "task", "episodes", "success\nrate", "\n95 %  ", "mean\nreturn", "\n95 %",
        "mean\nlength", "\n95 % ", "failed",
    )  # fmt: skip
    for task, own in [*by_task.items()] if len(by_task) < 2 else [*by_task.items(), ("all", found)]:
        table.add_row(
            task or "-",
            count(len(own.records)),
            *with_interval(own.success, lambda share: f"{share:.1%}"),
            *with_interval(own.total_reward, number),
            *with_interval(own.length, number),
            count(len(own.failed)),
        )
    return table


def _report(facts: dict[str, Any], found: QueueEvaluation, order: QueueOrder) -> None:
    by_task = found.by_task()
    if order.as_json:
        tasks = [{"task": task, **_figures(own)} for task, own in by_task.items()]
        episodes = [record.to_json() for record in found.records]
        print_json({**facts, **_figures(found), "tasks": tasks, "rows": episodes})
    else:
        title = f"{facts['policy']}: {counted(len(found.records), 'episode')} of {facts['queue']}"
        if facts["interrupted"]:
            title = f"Interrupted, so short episodes are favoured: {title}"
        print_table(out(), _table(title, by_task, found), ("\n95 % ", "\n95 %"))
        for note in _notes(found):
            out().print(note, markup=False)
    if order.plot is not None and found.records:
        figures = [(task, own, own.returns) for task, own in by_task.items()]
        draw_evaluation(facts["config"], figures, order.plot)


def _figures(found: QueueEvaluation) -> dict[str, Any]:
    failed = len(found.failed)
    return {
        "episodes": len(found.records), "failed": failed, "lost": found.lost, **estimates(found),
    }  # fmt: skip


def _notes(found: QueueEvaluation) -> list[str]:
    notes: list[str] = []
    if found.lost:
        notes.append(
            f"{counted(found.lost, 'attempt')} lost with a worker or by an error of an env"
        )
    if any(not math.isfinite(value) for value in found.returns):
        notes.append("some returns are NaN or infinite; figures with them are left out")
    failed = found.failed
    for record in failed[:_NAMED]:
        options = "" if record.options is None else f", options {json.dumps(record.options)}"
        notes.append(f"failed: task {record.task!r}, seed {record.seed}{options}: {record.cause}")
    if len(failed) > _NAMED:
        notes.append(f"and {count(len(failed) - _NAMED)} more failed; --json has all")
    return notes
