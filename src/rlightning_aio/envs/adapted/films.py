"""`record_video` of an entry's `env_kwargs`: Gymnasium's `RecordVideo` around each of its envs."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import gymnasium as gym
from gymnasium.wrappers import RecordVideo

from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from rlightning_aio.envs.base import BaseEnv

RECORD_VIDEO: Final = "record_video"


def record(env: BaseEnv, name: str, options: Any) -> None:
    """Put `RecordVideo` around the Gymnasium env of `env`.

    Films are called ``<env_id>-episode-<n>.mp4``, and n continues after those that the folder
    has, so that a replaced worker overwrites nothing.

    Args:
        env: as it was built.
        name: of its entry.
        options: of ``record_video``: the ``folder``, and perhaps ``every``: episodes 0, every,
            2 * every, … are filmed.

    Raises:
        ConfigError: these are something else, or the env is no single Gymnasium env that renders
            arrays.
    """
    where = f"entry {name!r}, env_kwargs.record_video"
    folder, every = _checked(options, where)
    inner: Any = getattr(env, "env", None)
    if not isinstance(inner, gym.Env):
        raise ConfigError(f"{where}: only an entry of single Gymnasium envs can be filmed")
    if inner.render_mode not in ("rgb_array", "rgb_array_list"):
        raise ConfigError(
            f"{where}: the env's render_mode is {inner.render_mode!r}; set env_kwargs.render_mode "
            "(or have your callable pass it on) to rgb_array"
        )
    prefix = env.env_id.replace("/", "_")

    def is_filmed(episode: int) -> bool:
        return episode % every == 0

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Overwriting existing videos")
        recorder: Any = cast("Any", RecordVideo)(
            inner,
            str(folder),
            episode_trigger=is_filmed,
            name_prefix=prefix,
            disable_logger=True,
        )
    own = re.compile(re.escape(prefix) + r"-episode-(\d+)\.mp4")
    found = [int(match[1]) for path in folder.iterdir() if (match := own.fullmatch(path.name))]
    recorder.episode_id = max(found, default=-1)
    env.env = recorder  # pyright: ignore[reportAttributeAccessIssue]


def _checked(given: Any, where: str) -> tuple[Path, int]:
    if isinstance(given, Mapping):
        options = dict(cast("Mapping[str, Any]", given))
        folder, every = options.pop("folder", None), options.pop("every", 1)
        if isinstance(folder, str) and folder and type(every) is int and every > 0 and not options:
            return Path(folder).expanduser().absolute(), every
    raise ConfigError(
        f"{where}: should be {{folder: DIR}} or {{folder: DIR, every: n}} with n above 0, not "
        f"{given!r}"
    )
