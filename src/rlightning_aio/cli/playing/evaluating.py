"""``rlightning-aio eval`` judges a policy: a number of episodes of each env, or a queue of them."""

from __future__ import annotations

import contextlib
import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self, TypeAlias

import typer

import rlightning_aio
from rlightning_aio.attempts import ResultsFile
from rlightning_aio.cli.bench.plots import check_plot, draw_evaluation
from rlightning_aio.cli.figures import estimates, with_interval
from rlightning_aio.cli.live_line import LiveLine, time_left
from rlightning_aio.cli.option_files import check_option_file
from rlightning_aio.cli.options import AsJson, Config, Overrides, PlotFile, TraceFile, check_seed
from rlightning_aio.cli.playing.queue_options import (
    EpisodesFile,
    QueueOptions,
    Retries,
    Seeds,
    Tasks,
)
from rlightning_aio.cli.policies.collecting import playing
from rlightning_aio.cli.policies.policies import load_policy, served_policy
from rlightning_aio.cli.policies.sb3_policies import SB3Policy, digest_of
from rlightning_aio.cli.terminal import (
    count,
    counted,
    named_columns,
    notes_on_returns,
    number,
    out,
    print_json,
    print_table,
    run_interruptible,
)
from rlightning_aio.config import MADE_BY_GYMNASIUM, load_config
from rlightning_aio.errors import ConfigError, RLightningError
from rlightning_aio.evaluation import Evaluation, evaluate
from rlightning_aio.evaluation.evaluation import parts_of
from rlightning_aio.json_text import finite
from rlightning_aio.policies import ActionChunks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.table import Table

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.attempts import Attempt
    from rlightning_aio.cli.policies.policies import Policy
    from rlightning_aio.config import EnvConfig
    from rlightning_aio.evaluation import EpisodeSpec

__all__ = ["evaluation"]

_RANDOM: Final = "random"
_NAMED: Final = 5
"""Number of failed episodes that a message names."""
_IN_SUBJECT: Final = (
    "name", "backend", "task", "num_envs", "max_episode_steps", "env_kwargs",
)  # fmt: skip
"""Fields of an entry that affect what comes of an episode; others only where and how it runs."""
_By: TypeAlias = Literal["entry", "task"]


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
_Video: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--video",
        metavar="FOLDER",
        help="Film the first episode of each task to this folder (MP4; needs imageio-ffmpeg).",
    ),
]
_Resume: TypeAlias = Annotated[
    Path | None,
    typer.Option(help="Save finished episodes to this file, and skip those already in it."),
]


@dataclass(frozen=True)
class _Whose:
    """Whose episodes are played, and how often they are retried.

    Attributes:
        named: a text that identifies the policy.
        facts: what the command was given, for JSON.
    """

    retries: int
    policy: Policy | None
    named: str
    facts: dict[str, Any]


@dataclass(frozen=True)
class _Order:
    """What is to be played.

    Attributes:
        episodes: a number for each env, or a queue.
        video: the folder for films.
        by: what the table has a line for; title: of the table.
    """

    configs: Sequence[EnvConfig]
    episodes: int | Sequence[EpisodeSpec]
    video: Path | None
    whose: _Whose
    by: _By
    title: str


@dataclass(frozen=True)
class _Files:
    """Where results go."""

    resume: Path | None
    plot: Path | None
    trace: Path | None
    as_json: bool

    def __post_init__(self) -> None:
        check_option_file("--trace", self.trace)
        check_plot(self.plot)


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
    retries: Retries = 2,
    resume: _Resume = None,
    plot: PlotFile = None,
    video: _Video = None,
    trace: TraceFile = None,
    as_json: AsJson = False,
) -> None:
    """Evaluate a policy: play a fixed set of episodes and print statistics.

    Either each env plays a number of episodes (--episodes), or the envs share a queue: each task of
    --tasks with each of --seeds, or the episodes of --episodes-file, each once, on any free env.
    An episode that is lost with its worker or by an exception is played again, up to --retries
    times. If any has failed then, the exit code is 1.

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
    files = _Files(resume, plot, trace, as_json)
    queue = QueueOptions(episodes_file, tasks, seeds)
    if queue.wanted:
        _refuse({"--episodes": episodes, "--seed": seed})
    facts = {"config": str(config), "policy": policy, "seed": seed}
    with contextlib.ExitStack() as stack:
        chosen, named = _policy(policy, algo, action_steps, stack)
        whose = _Whose(retries, chosen, named, facts)
        if queue.wanted:
            order = _in_queue(configs, queue, video, whose)
        else:
            order = _of_each(configs, episodes or 10, video, whose)
        _play(order, files, _resumed(order, resume, stack))


def _in_queue(
    configs: Sequence[EnvConfig], queue: QueueOptions, video: Path | None, whose: _Whose
) -> _Order:
    specs = queue.specs(configs)
    title = f"{whose.facts['policy']}: {counted(len(specs), 'episode')}"
    return _Order(configs, specs, video, whose, "task", title)


def _of_each(
    configs: Sequence[EnvConfig], episodes: int, video: Path | None, whose: _Whose
) -> _Order:
    whose.facts["episodes_each"] = episodes
    title = f"{whose.facts['policy']}: {counted(episodes, 'episode')} of each env"
    return _Order(configs, episodes, video, whose, "entry", title)


def _rendering(config: EnvConfig) -> EnvConfig:
    """Return `config` with simulators that can render frames."""
    if config.backend not in MADE_BY_GYMNASIUM:
        return config
    kwargs = {"render_mode": "rgb_array", **config.env_kwargs}
    return config.model_copy(update={"env_kwargs": kwargs})


def _refuse(given: dict[str, Any]) -> None:
    """Raise `ConfigError` if an option is given that a queue has no use for."""
    for option, value in given.items():
        if value is not None:
            raise ConfigError(
                f"{option} is for a number of episodes of each env; leave it out with --seeds or "
                "--episodes-file"
            )


def _resumed(order: _Order, resume: Path | None, stack: contextlib.ExitStack) -> ResultsFile | None:
    if resume is None:
        return None
    about = _subject(order.configs, order.whose.named)
    if isinstance(order.episodes, int):
        about["seed"] = order.whose.facts["seed"]
    try:
        return stack.enter_context(ResultsFile(resume, about))
    except ConfigError as error:
        raise ConfigError(f"--resume: {error}") from error


def _subject(configs: Sequence[EnvConfig], policy: str) -> dict[str, Any]:
    """Subject of the results in a file."""
    envs = [{name: getattr(config, name) for name in _IN_SUBJECT} for config in configs]
    # Values that JSON can't hold are compared by their `repr`.
    return finite(json.loads(json.dumps({"policy": policy, "envs": envs}, default=repr)))


def _play(order: _Order, files: _Files, results: ResultsFile | None) -> None:
    """Play the episodes, and report them."""
    configs = order.configs if order.video is None else [*map(_rendering, order.configs)]
    group = rlightning_aio.build_env_group(list(configs), mixed_actions=True)
    interrupted, stopped = True, False
    with _Watch(group, order) as watch:
        try:
            run_interruptible(_evaluate(group, order, files.trace, results, watch))
            interrupted = False
        except KeyboardInterrupt:
            stopped = True
            raise
        finally:
            # After an error, too: the episodes until then may be useful.
            watch.line.stop()
            if stopped or watch.found.attempts:
                _report(order, files, watch.found, interrupted=interrupted)
    if watch.found.failed:
        raise typer.Exit(1)


async def _evaluate(
    group: EnvGroup,
    order: _Order,
    trace: Path | None,
    results: ResultsFile | None,
    watch: _Watch,
) -> None:
    # The random actions of the saved episodes must not be drawn again.
    before = 0 if results is None else len(results.played)
    base: int | None = order.whose.facts["seed"]
    seed = None if base is None else base + before
    async with playing(group, order.whose.policy, seed, trace, watch.line.show) as policy:
        try:
            evaluated = evaluate(
                group,
                policy,
                order.episodes,
                seed=base,
                retries=order.whose.retries,
                results=results,
                on_episode=watch.note,
                video=order.video,
            )
            watch.ready(group)
            await evaluated
        except (ValueError, ImportError) as error:
            raise ConfigError(str(error)) from None
        except RLightningError:
            raise  # Some are an `OSError`, too.
        except OSError as error:
            raise ConfigError(
                f"--video {order.video}: can't be written: {error.strerror}"
            ) from None


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


class _Watch:
    """The episodes so far, and the live line on stderr."""

    def __init__(self, group: EnvGroup, order: _Order) -> None:
        self.found = Evaluation()
        self._order = order
        self._doing = f"starting {counted(len(group), 'env')}"
        self._total = self._before = 0
        self._begun = time.monotonic()
        self.line = LiveLine(self._parts, self._share_done)

    def __enter__(self) -> Self:
        self.line.__enter__()
        self.line.announce(self._doing)
        return self

    def __exit__(self, *exception: object) -> None:
        self.line.stop()

    def ready(self, group: EnvGroup) -> None:
        """Show that all envs have started, with the number of episodes."""
        episodes = self._order.episodes
        self._total = (
            sum(meta.num_envs for meta in group.metas) * episodes
            if isinstance(episodes, int)
            else len(episodes)
        )
        self._begun, self._before = time.monotonic(), len(self.found.attempts)
        before = f", {count(self._before)} of them played before" if self._before else ""
        self._doing = ""
        self.line.announce(f"playing {counted(self._total, 'episode')}{before}")

    def note(self, attempt: Attempt) -> None:
        """Count an episode."""
        self.found.attempts.append(attempt)

    def _share_done(self, _now: float) -> float | None:
        return None if self._doing else len(self.found.attempts) / max(1, self._total)

    def _parts(self, now: float) -> list[str]:
        if self._doing:
            return [self._doing]
        found, done = self.found, len(self.found.attempts)
        new = done - self._before
        parts = [f"{count(done)} of {counted(self._total, 'episode')}"]
        if new:
            parts.append(time_left((self._total - done) * (now - self._begun) / new))
        success, reward = found.success, found.total_reward
        parts += [] if success is None else [f"success {success.mean:.0%}"]
        parts += [] if reward is None else [f"mean return {number(reward.mean)}"]
        return [*parts, *([f"{count(len(found.failed))} failed"] if found.failed else [])]


# -- output ------------------------------------------------------------------------------


def _table(title: str, by: _By, parts: dict[str, Evaluation], found: Evaluation) -> Table:
    table = named_columns(
        title, by, "episodes", "success\nrate", "\n95 %  ", "mean\nreturn", "\n95 %",
        "mean\nlength", "\n95 % ", "failed",
    )  # fmt: skip
    for name, own in [*parts.items()] if len(parts) < 2 else [*parts.items(), ("all", found)]:
        table.add_row(
            name or "-",
            count(len(own.attempts)),
            *with_interval(own.success, lambda share: f"{share:.1%}"),
            *with_interval(own.total_reward, number),
            *with_interval(own.length, number),
            count(len(own.failed)),
        )
    return table


def _report(order: _Order, files: _Files, found: Evaluation, *, interrupted: bool) -> None:
    """Print and draw the results."""
    parts = parts_of(found, order.by)
    notes = _notes(found)
    if files.as_json:
        each = [{"name": name, **_figures(own)} for name, own in parts.items()]
        about = {**order.whose.facts, "interrupted": interrupted, "notes": notes, **_figures(found)}
        attempts = [attempt.to_json() for attempt in found.attempts]
        print_json({**about, "by": order.by, "parts": each, "attempts": attempts})
    else:
        title = order.title
        if interrupted:
            title = f"Interrupted, so short episodes are favoured: {title}"
        print_table(out(), _table(title, order.by, parts, found), ("\n95 % ", "\n95 %"))
        for note in notes:
            out().print(note, markup=False)
    if files.plot is not None and found.played:
        figures = [(name, own, own.returns) for name, own in parts.items() if own.played]
        draw_evaluation(order.whose.facts["config"], figures, files.plot)


def _figures(found: Evaluation) -> dict[str, Any]:
    return {
        "episodes": len(found.attempts), "failed": len(found.failed),
        "failures": dict(found.failures), **estimates(found),
    }  # fmt: skip


def _notes(found: Evaluation) -> list[str]:
    notes: list[str] = []
    if failures := found.failures:
        kinds = ", ".join(f"{count(failures[kind])} {kind}" for kind in sorted(failures))
        notes.append(f"tries that failed, by the kind of their outcome: {kinds}")
    notes += notes_on_returns(
        attempt.env_id for attempt in found.played if not math.isfinite(attempt.reward or 0.0)
    )
    failed = found.failed
    for attempt in failed[:_NAMED]:
        spec = attempt.spec
        options = "" if spec.options is None else f", options {json.dumps(spec.options)}"
        where = f"task {spec.task!r}, seed {spec.seed}{options}, on env {attempt.env_id!r}"
        notes.append(f"failed: {where}: {attempt.outcome.kind}: {attempt.outcome.cause}")
    if len(failed) > _NAMED:
        notes.append(f"and {count(len(failed) - _NAMED)} more failed; --json has all")
    return notes
