"""``rlightning-aio check`` builds and steps one env of each entry and prints its spaces."""

from __future__ import annotations

import asyncio
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

import rlightning_aio
from rlightning_aio._core.group.api.facade import ensure_auto_reset
from rlightning_aio.cli.options import Config, Overrides
from rlightning_aio.cli.policies.collecting import Roster, respond_to_all, responder
from rlightning_aio.cli.terminal import counted, out, print_json, run_interruptible
from rlightning_aio.cli.trial import Trial, try_out
from rlightning_aio.config import check_installed, load_config
from rlightning_aio.json_text import json_of
from rlightning_aio.registry import ENVS, load

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio._core.hosts.running.casts import Cast
    from rlightning_aio.config import EnvConfig

__all__ = ["check"]

_STEPS: Final = 3


@dataclass
class _Finding:
    """The findings about an entry; None where its env was not started.

    Attributes:
        skipped: the reason why it was not started.
        steps: how many steps it made; none if only a policy can choose its actions.
        offers: what the envs' own server says of them.
        trial: what whole episodes have shown.
    """

    name: str
    backend: str
    task: str
    num_workers: int
    num_envs: int
    observation_space: str | None = None
    action_space: str | None = None
    max_episode_steps: int | None = None
    skipped: str | None = None
    steps: int = 0
    offers: dict[str, Any] | None = None
    trial: Trial | None = None


def check(
    config: Config,
    overrides: Overrides = None,
    steps: Annotated[
        int, typer.Option(min=0, help="Play so many steps with random actions, and look closely.")
    ] = 0,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document instead of the text.")
    ] = False,
) -> None:
    """Check a config: build one env of each entry, step it a few times, print its spaces.

    Errors in the file are reported first, before anything is started. Robots are not
    started, and neither are env_servers, whose envs live elsewhere.

    For example:

        rlightning-aio check configs/cartpole.yaml
        rlightning-aio check configs/halfcheetah.yaml envs.0.task=Ant-v5
        rlightning-aio check configs/cartpole.yaml --steps 2000
    """
    configs = load_config(config, overrides or ())
    check_installed(configs)
    findings: list[_Finding] = []
    run_interruptible(_look(configs, findings, steps))
    if as_json:
        print_json({"config": str(config), "entries": [asdict(found) for found in findings]})
        return
    for found in findings:
        for line in _lines(found):
            out().print(line, soft_wrap=True, markup=False)


async def _look(configs: Sequence[EnvConfig], findings: list[_Finding], steps: int) -> None:
    for config in configs:
        found = _Finding(
            config.name, config.backend, config.task_name, config.num_workers, config.num_envs
        )
        if config.backend == "env_server":
            found.skipped = "its envs live with its clients"
        elif (backend := ENVS.described(config.backend)) and backend.described_by:
            found.offers = await asyncio.to_thread(load(backend.described_by), config)
        elif ENVS.is_hardware(config.backend):
            found.skipped = "it would move"
        else:
            await _try(config, found, steps)
        findings.append(found)


async def _try(config: EnvConfig, found: _Finding, steps: int) -> None:
    """Build one env of the entry and step it."""
    one = [config.model_copy(update={"num_workers": 1})]
    async with rlightning_aio.build_env_group(one) as group:
        (meta,) = group.metas
        found.observation_space = str(meta.observation_space)
        found.action_space = str(meta.action_space)
        found.num_envs = meta.num_envs
        found.max_episode_steps = config.max_episode_steps or meta.max_episode_steps
        respond = responder(group, Roster(group), None, 0)
        batch, _ = await group.reset(seed=0)
        if _has_no_samples(meta.action_space):
            return
        with ensure_auto_reset(group):
            for _ in range(_STEPS):
                await respond_to_all(group, respond, batch)
                batch, _ = await group.collect_async()
        found.steps = _STEPS
        if steps:
            found.trial = await try_out(group, steps)


def _has_no_samples(space: Any) -> bool:
    """Return True for actions that are plain Python values."""
    try:
        space.sample()
    except NotImplementedError:
        return True
    return False


def _lines(found: _Finding) -> list[str]:
    each = "" if found.num_envs == 1 else f", {found.num_envs} sub-environments in each"
    head = f"{found.name}: {counted(found.num_workers, 'env')}{each} ({found.backend}"
    head += f", {found.task})" if found.task else ")"
    if found.skipped is not None:
        return [head, f"  not started: {found.skipped}"]
    if found.offers is not None:
        return [head, *json_of(found.offers, indent=2).splitlines()]
    limit = found.max_episode_steps
    trial = found.trial
    return [
        head,
        f"  observation  {found.observation_space}",
        f"  action       {found.action_space}",
        f"  step limit   {limit or 'none'}",
        f"  reset and stepped {found.steps} times"
        if found.steps
        else "  reset; not stepped: only a policy can choose its actions",
        *([] if trial is None else _lines_of(trial)),
    ]


def _lines_of(trial: Trial) -> list[str]:
    return [
        f"  {counted(trial.episodes, 'episode')}; a step takes {trial.step_us:.0f} µs",
        *[f"  cast: {_words_of(cast)}" for cast in trial.casts],
        *[f"  problem: {problem}" for problem in trial.problems or ["none found"]],
        f"  {trial.advice}",
    ]


def _words_of(cast: Cast) -> str:
    loss = "numbers are rounded" if cast.rounds else "no number changes, but it takes time"
    return (
        f"{cast.part} from {cast.found} to {cast.expected}: {loss}; return arrays of "
        f"{cast.expected}, or declare a space of another dtype"
    )
