"""`record_video`: films of chosen envs and episodes, as Gymnasium's `RecordVideo` makes them.

An env is filmed where it lives: its worker renders and encodes, and no frame crosses to the
trainer.
"""

from __future__ import annotations

import difflib
import os
from typing import TYPE_CHECKING, Any

from rlightning_aio.config import MADE_BY_GYMNASIUM, EnvConfig, parse_configs
from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["record_video"]


def record_video(
    env_cfgs: Any,
    folder: str | os.PathLike[str],
    env_ids: Sequence[str] | None = None,
    *,
    sub_env: int = 0,
    every: int = 1,
    episodes: Sequence[int] | None = None,
) -> list[EnvConfig]:
    """Configurations of the same envs, of which some are filmed; for `build_env_group`.

    Args:
        env_cfgs: as `build_env_group` takes them.
        folder: gets ``<env id>-episode-<n>.mp4``, or, of an env with sub-environments,
            ``<env id>-sub-<k>-episode-<n>.mp4``; it is created if missing. An unfinished episode
            is called ``….partial.mp4``. A folder that has films of the env already
            gets further ones: n goes on from the last.
        env_ids: which envs; None: the first of each config entry.
        sub_env: which of an env's sub-environments.
        every: film episodes 0, every, 2 * every, … of each.
        episodes: film only these.

    Envs that `gymnasium.make` makes get ``render_mode: rgb_array``; others must be made such that
    ``render`` gives frames ``[height, width, 3]`` uint8. A film has the simulator's ``render_fps``.

    Raises:
        ConfigError: a config is wrong, no env has such an id, or an env can't be filmed.
    """
    configs = parse_configs(env_cfgs)
    chosen = _chosen(configs, env_ids)
    fields = {"folder": os.fspath(folder), "sub_env": sub_env, "every": every}
    fields |= {} if episodes is None else {"episodes": list(episodes)}
    return parse_configs(
        [
            _filmed(config, {**fields, "envs": own}) if own else config
            for config, own in zip(configs, chosen, strict=True)
        ]
    )


def _chosen(configs: Sequence[EnvConfig], env_ids: Sequence[str] | None) -> list[list[int]]:
    """Which envs of each entry."""
    if env_ids is None:
        return [[] if config.backend == "env_server" else [0] for config in configs]
    places = {
        f"{config.name}-{index}": (entry, index)
        for entry, config in enumerate(configs)
        for index in range(config.num_workers)
    }
    chosen: list[list[int]] = [[] for _ in configs]
    for env_id in dict.fromkeys(env_ids):
        if env_id not in places:
            near = difflib.get_close_matches(env_id, places, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(places)}"
            raise ConfigError(f"no env {env_id!r} to film; {hint}")
        entry, index = places[env_id]
        chosen[entry].append(index)
    return chosen


def _filmed(config: EnvConfig, video: dict[str, Any]) -> EnvConfig:
    fields = {name: getattr(config, name) for name in config.model_fields_set}
    if config.backend in MADE_BY_GYMNASIUM:
        fields["env_kwargs"] = {"render_mode": "rgb_array", **config.env_kwargs}
    try:
        return EnvConfig.model_validate({**fields, "video": video})
    except ValueError as error:
        raise ConfigError(f"entry {config.name!r}, video: {error}") from None
