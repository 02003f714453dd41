"""``rlightning-aio eval`` judges a policy: a number of episodes of each env, or a queue of them."""

from __future__ import annotations

import contextlib
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Self, TypeAlias

import typer
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

import rlightning_aio
from rlightning_aio.cli.bench.plots import check_plot, draw_evaluation
from rlightning_aio.cli.figures import estimates, with_interval
from rlightning_aio.cli.option_files import check_option_file
from rlightning_aio.cli.options import AsJson, Config, Overrides, PlotFile, TraceFile, check_seed
from rlightning_aio.cli.playing.evaluation_file import EvaluationFile, subject
from rlightning_aio.cli.playing.films import Video, VideoEnvs, VideoEvery, filmed
from rlightning_aio.cli.playing.queue_evaluating import QueueOrder, evaluate_queue
from rlightning_aio.cli.playing.queue_options import (
    EpisodesFile,
    MaxAttempts,
    QueueOptions,
    Seeds,
    Tasks,
    VideoEpisodes,
    VideoFailed,
)
from rlightning_aio.cli.policies.collecting import playing
from rlightning_aio.cli.policies.policies import load_policy, served_policy
from rlightning_aio.cli.policies.sb3_policies import SB3Policy, digest_of
from rlightning_aio.cli.terminal import (
    count,
    counted,
    err,
    named_columns,
    notes_on_returns,
    number,
    out,
    print_json,
    print_table,
    run_interruptible,
)
from rlightning_aio.config import load_config
from rlightning_aio.errors import ConfigError
from rlightning_aio.evaluation import Episode, Evaluation, evaluate
from rlightning_aio.policies import ActionChunks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.cli.policies.policies import Policy
    from rlightning_aio.config import EnvConfig

__all__ = ["evaluation"]

_RANDOM: Final = "random"


_ByEntry: TypeAlias = "Sequence[tuple[EnvConfig, Evaluation]]"
"""The entries of a config, each with the episodes of its envs."""


@dataclass(frozen=True)
class _Order:
    """The options of an evaluation."""

    configs: Sequence[EnvConfig]
    episodes: int
    seed: int | None
    policy: Policy | None
    played: Sequence[Episode]
    trace: Path | None


_PolicyOrModel: TypeAlias = Annotated[
    str,
    typer.Option(
        metavar="MODULE:CALLABLE|FILE.zip|openpi://HOST:PORT|vla-eval://HOST:PORT|random",
        help="Takes a batch, returns actions; or a model saved by Stable-Baselines3; or the "
        "address of a policy server.",
    ),
]
_ActionSteps: TypeAlias = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="The policy returns chunks of actions; play this many of each before the next.",
        show_default="all, of openpi://",
    ),
]
_Algo: TypeAlias = Annotated[
    str | None,
    typer.Option(
        help="Algorithm of the model in FILE.zip, such as PPO.", show_default="from the file"
    ),
]
_Episodes: TypeAlias = Annotated[
    int | None, typer.Option(min=1, help="Episodes for each env.", show_default="10")
]
_Seed: TypeAlias = Annotated[
    int | None, typer.Option(min=0, help="Base seed; each episode has its own seed.")
]
_Resume: TypeAlias = Annotated[
    Path | None,
    typer.Option(help="Save finished episodes to this file, and skip those already in it."),
]


@dataclass(frozen=True)
class _Output:
    """The facts that a report repeats, and the options for it."""

    config: Path
    policy: str
    seed: int | None
    episodes: int
    plot: Path | None
    as_json: bool

    def __post_init__(self) -> None:
        check_plot(self.plot)

    def report(self, configs: Sequence[EnvConfig], found: Evaluation, *, interrupted: bool) -> None:
        """Print and draw the results."""
        by_entry = _by_entry(configs, found)
        notes = notes_on_returns(
            episode.env_id for episode in found.episodes if not math.isfinite(episode.total_reward)
        )
        if found.lost:
            lost = counted(found.lost, "episode")
            notes.insert(0, f"{lost} lost with a worker and started again")
        if self.as_json:
            self._print_json(by_entry, found, notes, interrupted=interrupted)
        else:
            title = f"{self.policy}: {counted(self.episodes, 'episode')} of each env"
            if interrupted:
                title = f"Interrupted, so short episodes are favoured: {title}"
            _print_table(title, by_entry)
            for note in notes:
                out().print(note, markup=False)
        if self.plot is not None and found.episodes:
            figures = [(config.name, own, own.returns) for config, own in by_entry]
            draw_evaluation(str(self.config), figures, self.plot)

    def _print_json(
        self, by_entry: _ByEntry, found: Evaluation, notes: list[str], *, interrupted: bool
    ) -> None:
        print_json(
            {
                "config": str(self.config),
                "policy": self.policy,
                "seed": self.seed,
                "episodes_each": self.episodes,
                "interrupted": interrupted,
                "lost": found.lost,
                "notes": notes,
                "entries": [
                    {"name": config.name, "episodes": len(own.episodes), **estimates(own)}
                    for config, own in by_entry
                ],
                "episodes": [asdict(episode) for episode in found.episodes],
            }
        )


def evaluation(
    config: Config,
    overrides: Overrides = None,
    policy: _PolicyOrModel = _RANDOM,
    algo: _Algo = None,
    action_steps: _ActionSteps = None,
    episodes: _Episodes = None,
    seed: _Seed = None,
    episodes_file: EpisodesFile = None,
    tasks: Tasks = None,
    seeds: Seeds = None,
    max_attempts: MaxAttempts = 3,
    resume: _Resume = None,
    plot: PlotFile = None,
    video: Video = None,
    video_env: VideoEnvs = None,
    video_every: VideoEvery = None,
    video_failed: VideoFailed = False,
    video_episode: VideoEpisodes = None,
    trace: TraceFile = None,
    as_json: AsJson = False,
) -> None:
    """Evaluate a policy: play a fixed set of episodes and print statistics.

    Either each env plays a number of episodes (--episodes), or the envs share a queue: each task of
    --tasks with each of --seeds, or the episodes of --episodes-file, each once, on any free env.
    An episode of a queue that is lost with its worker is played again.

    Means and success rates have 95 % intervals. The episodes that end first would not be a fair
    sample, because envs with short episodes would have more of them. Success is the value of
    success or is_success in the last info of an episode. Ctrl-C ends early and prints the results
    so far, which are not a fair sample either. With --resume the same command continues from there.

    For example:

        rlightning-aio eval configs/cartpole.yaml --episodes 5 --seed 0
        rlightning-aio eval configs/hopper.yaml --policy my_policies:greedy --seeds 0:50
        rlightning-aio eval configs/halfcheetah.yaml --policy model.zip --video films --plot it.png
    """
    check_seed(seed)
    configs = load_config(config, overrides or ())
    _check_envs(config, configs)
    check_option_file("--trace", trace)
    films = (video, video_every, video_failed, video_episode)
    queue = QueueOptions(episodes_file, tasks, seeds, max_attempts, *films)
    with contextlib.ExitStack() as stack:
        chosen, named = _policy(policy, algo, action_steps, stack)
        if queue.wanted:
            _refuse({"--episodes": episodes, "--seed": seed, "--video-env": video_env})
            facts = {"config": str(config), "policy": policy}
            evaluate_queue(
                configs, queue, QueueOrder(chosen, named, resume, plot, trace, as_json, facts)
            )
            return
        output = _Output(config, policy, seed, episodes or 10, plot, as_json)
        about = subject(configs, named, seed)
        configs = filmed(configs, video, video_env, video_every)
        kept = None if resume is None else stack.enter_context(EvaluationFile(resume, about))
        played = _within([] if kept is None else kept.played, output.episodes)
        _play(_Order(configs, output.episodes, seed, chosen, played, trace), kept, output)


def _refuse(given: dict[str, Any]) -> None:
    """Raise `ConfigError` if an option is given that a queue has no use for."""
    for option, value in given.items():
        if value is not None:
            raise ConfigError(
                f"{option} is for a number of episodes of each env; leave it out with --seeds or "
                "--episodes-file"
            )


def _play(order: _Order, kept: EvaluationFile | None, output: _Output) -> None:
    """Play a number of episodes of each env, and report them."""
    group = rlightning_aio.build_env_group(order.configs, mixed_actions=True)
    interrupted, stopped = True, False
    with _Watch(group, order, kept) as watch:
        try:
            run_interruptible(_evaluate(group, order, watch))
            interrupted = False
        except KeyboardInterrupt:
            stopped = True
            raise
        finally:
            # After an error, too: the episodes until then may be useful.
            watch.stop()
            if stopped or watch.found.episodes:
                output.report(order.configs, watch.found, interrupted=interrupted)


def _check_envs(path: Path, configs: Sequence[EnvConfig]) -> None:
    for index, config in enumerate(configs):
        if config.backend == "env_server":
            raise ConfigError(
                f"{path}: envs.{index} ({config.name!r}), backend: clients of an env_server come "
                "and go, so they can't all play the same number of episodes; evaluate the env "
                "where it runs"
            )


def _policy(
    name: str, algorithm: str | None, steps: int | None, stack: contextlib.ExitStack
) -> tuple[Policy | None, str]:
    """Return the policy, or None for random actions, and a text that identifies it."""
    if name.endswith(".zip"):
        if steps is not None:
            raise ConfigError(f"--action-steps is for policies that return chunks, not {name!r}")
        model = SB3Policy(Path(name), algorithm)
        return model, f"{name}, SHA-256 {digest_of(Path(name))}"
    if algorithm is not None:
        raise ConfigError(f"--algo is for a model that Stable-Baselines3 has saved, not {name!r}")
    if name == _RANDOM:
        if steps is not None:
            raise ConfigError("--action-steps is for policies that return chunks, not 'random'")
        return None, name
    policy = served_policy(name, stack) if "://" in name else load_policy(name)
    if steps is None and not name.startswith("openpi://"):
        return policy, name
    played = "" if steps is None else f", {counted(steps, 'action')} of each chunk"
    return ActionChunks(policy, steps), f"{name}{played}"


def _within(played: Sequence[Episode], episodes: int) -> list[Episode]:
    """Leave out saved episodes beyond the present number."""
    return [episode for episode in played if episode.number < episodes]


async def _evaluate(group: EnvGroup, order: _Order, watch: _Watch) -> None:
    # The random actions of the saved episodes must not be drawn again.
    seed = None if order.seed is None else order.seed + len(order.played)
    async with playing(group, order.policy, seed, order.trace, watch.draw) as policy:
        watch.ready(sum(meta.num_envs for meta in group.metas) * order.episodes)
        watch.found = await evaluate(
            group,
            policy,
            order.episodes,
            seed=order.seed,
            played=order.played,
            on_episode=watch.note,
        )


class _Watch:
    """The figures so far, and the live line on stderr."""

    def __init__(self, group: EnvGroup, order: _Order, kept: EvaluationFile | None) -> None:
        self.found = Evaluation(list(order.played))
        self._kept = kept
        self._console = err()
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=16),
            TextColumn("{task.completed:.0f} of {task.total:.0f} episodes"),
            TextColumn("{task.fields[figures]}"),
            TimeRemainingColumn(),
            console=self._console,
            auto_refresh=False,
            transient=True,
        )
        starting = f"starting {counted(len(group), 'env')}"
        self._task = self._progress.add_task(
            starting, total=1, completed=len(order.played), figures=""
        )
        self._starting = starting

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._progress.start()
            self._progress.refresh()
        else:
            self._console.print(self._starting)
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End the live line."""
        if self._console.is_terminal:
            self._progress.stop()

    def ready(self, total: int) -> None:
        """Show that all envs have started, with the number of episodes."""
        done = len(self.found.episodes)
        if self._console.is_terminal:
            self._progress.update(self._task, description="", total=total)
        else:
            before = f", {count(done)} of them played before" if done else ""
            self._console.print(f"playing {counted(total, 'episode')}{before}")

    def note(self, episode: Episode) -> None:
        """Count a finished episode."""
        self.found.episodes.append(episode)
        if self._kept is not None:
            self._kept.add(episode)

    def draw(self) -> None:
        """Draw the live line."""
        if self._console.is_terminal:
            reward = self.found.total_reward
            figures = f"return {number(reward and reward.mean)}"
            done = len(self.found.episodes)
            self._progress.update(self._task, completed=done, figures=figures)
            self._progress.refresh()


# -- output ------------------------------------------------------------------------------


def _by_entry(configs: Sequence[EnvConfig], found: Evaluation) -> _ByEntry:
    return [
        (config, found.of_envs(f"{config.name}-{k}" for k in range(config.num_workers)))
        for config in configs
    ]


def _print_table(title: str, by_entry: _ByEntry) -> None:
    table = named_columns(
        title,
        "entry", "envs", "episodes", "mean\nreturn", "\n95 %", "mean\nlength", "\n95 % ",
        "success\nrate", "\n95 %  ",
    )  # fmt: skip
    for config, found in by_entry:
        success = found.success
        table.add_row(
            config.name,
            count(config.num_workers * config.num_envs),
            count(len(found.episodes)),
            *with_interval(found.total_reward, number),
            *with_interval(found.length, number),
            *with_interval(success, lambda share: f"{share:.1%}"),
        )
    print_table(out(), table, ("\n95 % ", "envs"))
