"""``rlightning-aio eval``: equally many episodes of each env, and what they say of a policy."""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Self

import typer
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

import rlightning_aio
from rlightning_aio.cli.collecting import Roster, check_trace, resetting, responder, traced
from rlightning_aio.cli.evaluation_file import EvaluationFile, subject
from rlightning_aio.cli.films import Video, VideoEnvs, VideoEvery, filmed
from rlightning_aio.cli.options import AsJson, Config, Overrides, TraceFile
from rlightning_aio.cli.plots import check_plot, draw_evaluation
from rlightning_aio.cli.policies import load_policy
from rlightning_aio.cli.sb3_policies import SB3Policy, digest_of
from rlightning_aio.cli.terminal import (
    INTERRUPTED,
    count,
    counted,
    err,
    interruptible,
    named_columns,
    number,
    out,
    print_json,
    print_table,
)
from rlightning_aio.config import load_config
from rlightning_aio.errors import ConfigError
from rlightning_aio.evaluation import Episode, Estimate, Evaluation, evaluate

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.cli.policies import Policy, Responder
    from rlightning_aio.config import EnvConfig
    from rlightning_aio.group.aio import EnvGroup

__all__ = ["evaluation"]

_REFRESH_SECONDS: Final = 0.2
_RANDOM: Final = "random"


@dataclass(frozen=True)
class _Order:
    """What to evaluate, and how."""

    configs: Sequence[EnvConfig]
    episodes: int
    seed: int | None
    policy: Policy | None
    played: Sequence[Episode]
    trace: Path | None


def evaluation(
    config: Config,
    overrides: Overrides = None,
    policy: Annotated[
        str,
        typer.Option(
            metavar="MODULE:CALLABLE|FILE.zip|random",
            help="Takes a batch, returns actions; or a model saved by Stable-Baselines3.",
        ),
    ] = _RANDOM,
    algo: Annotated[
        str | None,
        typer.Option(
            help="Algorithm of the model in FILE.zip, such as PPO.", show_default="from the file"
        ),
    ] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes for each env.")] = 10,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Base seed; each episode has its own seed.")
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(help="Save finished episodes to this file, and skip those already in it."),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Also draw the results (PNG, SVG or PDF; needs matplotlib).")
    ] = None,
    video: Video = None,
    video_env: VideoEnvs = None,
    video_every: VideoEvery = None,
    trace: TraceFile = None,
    as_json: AsJson = False,
) -> None:
    """Evaluate a policy: play a fixed number of episodes for each env and print statistics.

    Means and success rates have 95 % intervals. The episodes that end first would not be a fair
    sample, because envs with short episodes would have more of them. Success is the value of
    success or is_success in the last info of an episode. Ctrl-C ends early and prints the results
    so far, which are not a fair sample either. With --resume the same command continues from there.

    For example:

        rlightning-aio eval configs/cartpole.yaml --episodes 5 --seed 0
        rlightning-aio eval configs/hopper.yaml --policy my_policies:greedy --resume hopper.jsonl
        rlightning-aio eval configs/halfcheetah.yaml --policy model.zip --video films --plot it.png
    """
    configs = load_config(config, overrides or ())
    _check_envs(config, configs)
    if plot is not None:
        check_plot(plot)
    check_trace(trace)
    chosen, named = _policy(policy, algo)
    about = subject(configs, named, seed)
    configs = filmed(configs, video, video_env, video_every)
    with contextlib.ExitStack() as stack:
        kept = None if resume is None else stack.enter_context(EvaluationFile(resume, about))
        group = rlightning_aio.build_env_group(configs, mixed_actions=True)
        played = _within([] if kept is None else kept.played, episodes)
        order = _Order(configs, episodes, seed, chosen, played, trace)
        watch = stack.enter_context(_Watch(group, order, kept))
        interrupted = stopped = False
        try:
            with interruptible(), contextlib.closing(_evaluate(group, order, watch)) as playing:
                rlightning_aio.run(playing)
        except KeyboardInterrupt:
            interrupted = stopped = True
            raise typer.Exit(INTERRUPTED) from None
        except BaseException:
            interrupted = True
            raise
        finally:
            # Also after an error: what was played until then is worth knowing.
            watch.stop()
            facts = {
                "config": str(config),
                "policy": policy,
                "seed": seed,
                "episodes_each": episodes,
                "interrupted": interrupted,
            }
            if stopped or watch.found.episodes:
                _report(facts, configs, watch.found, plot, as_json=as_json)


def _check_envs(path: Path, configs: Sequence[EnvConfig]) -> None:
    for index, config in enumerate(configs):
        if config.backend == "env_server":
            raise ConfigError(
                f"{path}: envs.{index} ({config.name!r}), backend: clients of an env_server come "
                "and go, so they can't all play the same number of episodes; evaluate the env "
                "where it runs"
            )


def _policy(name: str, algorithm: str | None) -> tuple[Policy | None, str]:
    """The policy, None for random actions, and what tells it from others."""
    if name.endswith(".zip"):
        policy = SB3Policy(Path(name), algorithm)
        return policy, f"{name}, SHA-256 {digest_of(Path(name))}"
    if algorithm is not None:
        raise ConfigError(f"--algo is for a model that Stable-Baselines3 has saved, not {name!r}")
    return (None if name == _RANDOM else load_policy(name)), name


def _within(played: Sequence[Episode], episodes: int) -> list[Episode]:
    """Those of more episodes that were asked for before."""
    return [episode for episode in played if episode.number < episodes]


async def _evaluate(group: EnvGroup, order: _Order, watch: _Watch) -> None:
    async with group, traced(group, order.trace):
        metas = await group.init()
        if isinstance(order.policy, SB3Policy):
            order.policy.check(metas)
        # What was drawn for the episodes before is not drawn again.
        seed = None if order.seed is None else order.seed + len(order.played)
        respond = responder(group, Roster(group, metas), order.policy, seed)
        watch.ready(sum(meta.num_envs for meta in metas) * order.episodes)
        with resetting(group, order.configs):
            watch.found = await evaluate(
                group,
                watch.seeing(group, respond),
                order.episodes,
                seed=order.seed,
                min_batch=max(1, len(group) // 2),
                played=order.played,
                on_episode=watch.note,
            )


class _Watch:
    """What has been played so far, and the live line on stderr."""

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
        self._next_at = 0.0

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
        """No more is shown."""
        if self._console.is_terminal:
            self._progress.stop()

    def ready(self, total: int) -> None:
        """All envs have started; so many episodes are to be had."""
        done = len(self.found.episodes)
        if self._console.is_terminal:
            self._progress.update(self._task, description="", total=total)
        else:
            before = f", {count(done)} of them played before" if done else ""
            self._console.print(f"playing {counted(total, 'episode')}{before}")

    def note(self, episode: Episode) -> None:
        """An episode has ended."""
        self.found.episodes.append(episode)
        if self._kept is not None:
            self._kept.add(episode)

    def seeing(self, group: EnvGroup, respond: Responder) -> Callable[[BatchedData], Any]:
        """`respond`, with the live line drawn now and then."""

        async def answer(batch: BatchedData) -> list[BatchedData]:
            if time.monotonic() >= self._next_at:
                self._next_at = time.monotonic() + _REFRESH_SECONDS
                self._show()
                # Where results never keep us waiting, nothing else would let Ctrl-C in.
                await asyncio.sleep(0)
            with group.span("policy"):
                return await respond(batch)

        return answer

    def _show(self) -> None:
        if self._console.is_terminal:
            reward = self.found.total_reward
            figures = f"return {number(reward and reward.mean)}"
            done = len(self.found.episodes)
            self._progress.update(self._task, completed=done, figures=figures)
            self._progress.refresh()


# -- what is printed --------------------------------------------------------------------


def _by_entry(
    configs: Sequence[EnvConfig], found: Evaluation
) -> list[tuple[EnvConfig, Evaluation]]:
    return [
        (config, found.of_envs(f"{config.name}-{k}" for k in range(config.num_workers)))
        for config in configs
    ]


def _report(
    facts: dict[str, Any],
    configs: Sequence[EnvConfig],
    found: Evaluation,
    plot: Path | None,
    *,
    as_json: bool,
) -> None:
    by_entry = _by_entry(configs, found)
    if as_json:
        entries = [{"name": config.name, **_figures(own)} for config, own in by_entry]
        episodes = [asdict(episode) for episode in found.episodes]
        print_json({**facts, "lost": found.lost, "entries": entries, "episodes": episodes})
    else:
        _print_table(facts, by_entry, found.lost)
    if plot is not None and found.episodes:
        draw_evaluation(facts["config"], [(c.name, own) for c, own in by_entry], plot)


def _figures(found: Evaluation) -> dict[str, Any]:
    estimates = {
        "total_reward": found.total_reward, "length": found.length, "success": found.success,
    }  # fmt: skip
    told = {name: None if one is None else asdict(one) for name, one in estimates.items()}
    return {"episodes": len(found.episodes), **told}


def _print_table(
    facts: dict[str, Any], by_entry: Sequence[tuple[EnvConfig, Evaluation]], lost: int
) -> None:
    title = f"{facts['policy']}: {counted(facts['episodes_each'], 'episode')} of each env"
    if facts["interrupted"]:
        title = f"Interrupted, so short episodes are favoured: {title}"
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
            *_with_interval(found.total_reward, number),
            *_with_interval(found.length, number),
            *_with_interval(success, lambda share: f"{share:.1%}"),
        )
    console = out()
    print_table(console, table, ("\n95 % ", "envs"))
    if lost:
        console.print(f"{counted(lost, 'episode')} lost with a worker, and started again")


def _with_interval(one: Estimate | None, words: Callable[[float], str]) -> tuple[str, str]:
    if one is None:
        return "-", "-"
    if one.low is None or one.high is None:
        return words(one.mean), "-"
    return words(one.mean), f"{words(one.low)} to {words(one.high)}"
