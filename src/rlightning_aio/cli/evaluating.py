"""``rlightning-aio eval`` judges a policy: a number of episodes of each env, or a queue of them."""

from __future__ import annotations

import contextlib
import json
from dataclasses import asdict, dataclass, field

# Typer reads annotations.
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeAlias

import typer

import rlightning_aio
from rlightning_aio._core.group.state.episodes import checked_seed
from rlightning_aio.attempts import ResultsFile
from rlightning_aio.cli.options import (
    AsJson,
    Config,
    Overrides,
    PlotFile,
    PolicyName,
    Seed,
)
from rlightning_aio.cli.plots import check_plot, draw_evaluation
from rlightning_aio.cli.policies import Responder, load_policy, servers_announced
from rlightning_aio.cli.terminal import (
    Progress,
    connections_logged,
    count,
    counted,
    print_json,
    print_lines,
    run_interruptible,
)
from rlightning_aio.config import MADE_BY_GYMNASIUM, load_config
from rlightning_aio.errors import ConfigError, RLightningError
from rlightning_aio.evaluation import EpisodeSpec, Evaluation, evaluate
from rlightning_aio.evaluation.evaluation import parts_of, table_of
from rlightning_aio.json_text import finite

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.attempts import Attempt
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.config import EnvConfig

_RANDOM: Final = "random"
_NAMED: Final = 5
"""Number of failed episodes that a message names."""
_IN_SUBJECT: Final = (
    "name", "backend", "task", "num_envs", "max_episode_steps", "env_kwargs",
)  # fmt: skip
"""Fields of an entry that affect what comes of an episode; others only where and how it runs."""
_By: TypeAlias = Literal["entry", "task"]
_End: TypeAlias = Literal["Interrupted", "Ended by an error"]

_Episodes: TypeAlias = Annotated[
    int | None, typer.Option(min=1, help="Episodes for each env.", show_default="10")
]

_Tasks: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        metavar="TASK,…",
        help="Play these tasks with each of --seeds, on any free env.",
        show_default="those of the config",
    ),
]

_Seeds: TypeAlias = Annotated[
    str | None,
    typer.Option(metavar="FIRST:END|SEED,…", help="Play each task once with each of these seeds."),
]

_Retries: TypeAlias = Annotated[
    int,
    typer.Option(
        min=0, help="How often an episode is played again that was lost, before it has failed."
    ),
]

_Resume: TypeAlias = Annotated[
    Path | None,
    typer.Option(help="Save finished episodes to this file, and skip those already in it."),
]

_Video: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        help="Film the first episode of each task to this folder (MP4; needs imageio-ffmpeg).",
    ),
]


@dataclass
class _Order:
    """What is to be played, and what came of it.

    Attributes:
        episodes: a number for each env, or a queue.
        seed: of a number of episodes.
        by: what the table has a line for; title: of the table.
        facts: what the command was given, for JSON.
    """

    configs: Sequence[EnvConfig]
    episodes: int | Sequence[EpisodeSpec]
    seed: int | None
    retries: int
    video: Path | None
    by: _By
    title: str
    facts: dict[str, Any]
    found: Evaluation = field(default_factory=Evaluation)


def evaluation(
    config: Config,
    overrides: Overrides = None,
    policy: PolicyName = None,
    episodes: _Episodes = None,
    seed: Seed = None,
    tasks: _Tasks = None,
    seeds: _Seeds = None,
    retries: _Retries = 2,
    resume: _Resume = None,
    plot: PlotFile = None,
    video: _Video = None,
    as_json: AsJson = False,
) -> None:
    """Evaluate a policy: play a fixed set of episodes and print statistics.

    Either each env plays a number of episodes (--episodes), or the envs share a queue: each task of
    --tasks with each of --seeds, once, on any free env.
    An episode that is lost with its worker or by an exception is played again, up to --retries
    times. If any has failed then, the exit code is 1.

    Means and success rates have 95 % intervals. The episodes that end first would not be a fair
    sample, because envs with short episodes would have more of them. Success is success or
    is_success in the last info of an episode, True or above 0.5. Ctrl-C ends early and prints the
    results so far, which are not a fair sample either. With --resume the same command continues
    from there.

    For example:

        rlightning-aio eval configs/cartpole.yaml --episodes 5 --seed 0
        rlightning-aio eval configs/hopper.yaml --policy my_policies:greedy --seeds 0:50
        rlightning-aio eval configs/halfcheetah.yaml --policy my_policies:model --video films
    """
    check_plot(plot)
    configs = load_config(config, overrides or ())
    named = policy or _RANDOM
    facts = {"config": str(config), "policy": named, "seed": seed}
    if seeds is not None or tasks:
        if episodes is not None or seed is not None:
            raise ConfigError(
                "--episodes and --seed are for a number of episodes of each env; leave them out "
                "with --tasks and --seeds"
            )
        queue = _queue(configs, tasks or (), seeds)
        title = f"{named}: {counted(len(queue), 'episode')}"
        order = _Order(configs, queue, None, retries, video, "task", title, facts)
    else:
        each = facts["episodes_each"] = episodes or 10
        title = f"{named}: {counted(each, 'episode')} of each env"
        order = _Order(configs, each, seed, retries, video, "entry", title, facts)
    with contextlib.ExitStack() as stack:
        chosen = load_policy(policy) if policy else None
        _play(order, chosen, _resumed(order, resume, stack), plot, as_json=as_json)


def _queue(
    configs: Sequence[EnvConfig], tasks: Sequence[str], text: str | None
) -> list[EpisodeSpec]:
    """Return the episodes in the order in which they begin."""
    if text is None:
        raise ConfigError("--tasks needs the seeds of their episodes: add --seeds 0:50")
    first, colon, end = text.partition(":")
    try:
        given = range(int(first or 0), int(end)) if colon else map(int, text.split(","))
        seeds = [*map(checked_seed, given)]
    except ValueError:
        seeds = []
    if not seeds:
        raise ConfigError(f"--seeds {text!r}: should look like 0:50 or 1,2,5")
    named = [(name, "") for given in tasks for name in given.split(",") if name]
    named = named or [(config.task_name, config.name) for config in configs]
    return [EpisodeSpec(task, seed, entry=entry) for task, entry in named for seed in seeds]


def _resumed(order: _Order, resume: Path | None, stack: contextlib.ExitStack) -> ResultsFile | None:
    if resume is None:
        return None
    envs = [{name: getattr(config, name) for name in _IN_SUBJECT} for config in order.configs]
    # Values that JSON can't hold are compared by their `repr`.
    text = json.dumps({"policy": order.facts["policy"], "envs": envs}, default=repr)
    about = finite(json.loads(text))
    if isinstance(order.episodes, int):
        about["seed"] = order.seed
    try:
        return stack.enter_context(ResultsFile(resume, about))
    except ConfigError as error:
        raise ConfigError(f"--resume: {error}") from error


def _play(
    order: _Order, policy: Any, results: ResultsFile | None, plot: Path | None, *, as_json: bool
) -> None:
    """Play the episodes, and report them."""
    configs = [*order.configs] if order.video is None else [*map(_rendering, order.configs)]
    group = rlightning_aio.build_env_group(configs, mixed_actions=True)
    ended: _End | None = "Ended by an error"
    try:
        with Progress() as progress, connections_logged():
            run_interruptible(_evaluate(group, order, policy, results, progress))
        ended = None
    except KeyboardInterrupt:
        ended = "Interrupted"
        raise
    finally:
        # After an error, too: the episodes until then may be useful.
        if ended == "Interrupted" or order.found.attempts:
            _report(order, plot, ended, as_json=as_json)
    if order.found.failed:
        raise typer.Exit(1)


def _rendering(config: EnvConfig) -> EnvConfig:
    """Return `config` with simulators that can render frames."""
    if config.backend not in MADE_BY_GYMNASIUM:
        return config
    kwargs = {"render_mode": "rgb_array", **config.env_kwargs}
    return config.model_copy(update={"env_kwargs": kwargs})


async def _evaluate(
    group: EnvGroup, order: _Order, policy: Any, results: ResultsFile | None, progress: Progress
) -> None:
    progress.begin(f"starting {counted(len(group), 'env')}")
    # The random actions of the saved episodes must not be drawn again.
    before = 0 if results is None else len(results)
    async with group:
        if servers_announced(group, progress):
            await group.reset()  # Clients tell their spaces when they dial in.
        respond = Responder(group, policy, None if order.seed is None else order.seed + before)
        try:
            played = evaluate(
                group,
                _with_progress(respond, order, progress),
                order.episodes,
                seed=order.seed,
                retries=order.retries,
                results=results,
                video=order.video,
                on_episode=order.found.attempts.append,
            )
            episodes = order.episodes
            if isinstance(episodes, int):
                total = episodes * sum(meta.num_envs for meta in group.metas)
            else:
                total = len(episodes)
            known = len(order.found.attempts)
            words = f", {count(known)} of them played before" if known else ""
            progress.begin(f"playing {counted(total, 'episode')}{words}", total)
            await played
        except RLightningError:
            raise  # Of an action that doesn't fit, for one, which is a ValueError, too.
        except (ValueError, ImportError) as error:
            raise ConfigError(str(error)) from error


def _with_progress(
    respond: Responder, order: _Order, progress: Progress
) -> Callable[[BatchedData], Any]:
    """Return the policy, which shows the figures so far now and then."""

    def words() -> str:
        found = order.found
        parts = [counted(len(found.attempts), "episode")]
        parts += [] if found.success is None else [f"success {found.success.mean:.0%}"]
        parts += [] if found.total_reward is None else [f"return {found.total_reward.mean:,.2f}"]
        return ", ".join([*parts, *([f"{count(len(found.failed))} failed"] * bool(found.failed))])

    async def answer(batch: BatchedData) -> list[BatchedData]:
        await progress.show(len(order.found.attempts), words)
        return await respond(batch)

    return answer


# -- output ------------------------------------------------------------------------------


def _report(order: _Order, plot: Path | None, ended: _End | None, *, as_json: bool) -> None:
    """Print and draw the results; `ended` says why there are fewer than were asked for."""
    found = order.found
    parts, notes = parts_of(found, order.by), _notes(found)
    if as_json:
        each = [{"name": name, **_figures(own)} for name, own in parts.items()]
        about = {
            **order.facts,
            "interrupted": ended == "Interrupted",
            "notes": notes,
            **_figures(found),
        }
        attempts = [attempt.to_json() for attempt in found.attempts]
        print_json({**about, "by": order.by, "parts": each, "attempts": attempts})
    else:
        title = order.title
        if ended is not None:
            known = counted(len(found.attempts), "episode")
            title = f"{ended} after {known}, so short ones are favoured: {title} were to be played"
        print_lines([title, table_of(found, order.by), *notes])
    if plot is not None and found.played:
        figures = [(name, own, own.returns) for name, own in parts.items() if own.played]
        draw_evaluation(order.facts["config"], figures, plot)


def _figures(found: Evaluation) -> dict[str, Any]:
    named = {"total_reward": found.total_reward, "length": found.length, "success": found.success}
    return {
        "episodes": len(found.attempts),
        "failed": len(found.failed),
        "failures": dict(found.failures),
        **{name: None if one is None else asdict(one) for name, one in named.items()},
    }


def _notes(found: Evaluation) -> list[str]:
    notes = found.remarks
    if failures := found.failures:
        kinds = ", ".join(f"{count(failures[kind])} {kind}" for kind in sorted(failures))
        notes.append(f"tries that failed, by the kind of their outcome: {kinds}")
    failed = found.failed
    notes += [_failure(attempt) for attempt in failed[:_NAMED]]
    if len(failed) > _NAMED:
        notes.append(f"and {count(len(failed) - _NAMED)} more failed; --json has all")
    return notes


def _failure(attempt: Attempt) -> str:
    spec, outcome = attempt.spec, attempt.outcome
    where = f"task {spec.task!r}, seed {spec.seed}, on env {attempt.env_id!r}"
    return f"failed: {where}: {outcome.kind}: {outcome.cause}"
