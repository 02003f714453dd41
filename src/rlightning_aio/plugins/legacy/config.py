"""RLightning's configs: mutable, open to extra fields, and readable like dicts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self, cast

import yaml
from pydantic import BaseModel, ConfigDict, Field, model_validator

if TYPE_CHECKING:
    import os

_NOT_VECTORIZED: Final = ("ale", "env_server", "mujoco", "piper")


class Config(BaseModel):
    """A section of a config; mappings among its extra fields become sections, too."""

    model_config = ConfigDict(extra="allow", frozen=False)

    @model_validator(mode="after")
    def _make_sections_of_mappings(self) -> Self:
        for name, value in (self.model_extra or {}).items():
            if isinstance(value, dict):
                setattr(self, name, Config.from_dict(cast("dict[str, Any]", value)))
        return self

    def get(self, name: str, default: Any = None) -> Any:
        """Return the field `name`, or `default`."""
        return getattr(self, name, default)

    @classmethod
    def load_yaml(cls, file_path: str | os.PathLike[str]) -> Self:
        """Read a YAML file."""
        return cls.from_dict(yaml.safe_load(Path(file_path).read_text(encoding="utf-8")))

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """Make a config of a mapping.

        Raises:
            ValueError: fields are wrong; the message has a line for each.
        """
        return cls.model_validate(data)

    def to_dict(self) -> dict[str, Any]:
        """Return the config as nested plain dicts."""
        return self.model_dump()


class EnvConfig(Config):
    """One entry of ``env:``, which makes ``num_workers`` envs of one kind.

    Fields of rlightning_aio's own `EnvConfig` (``placement``, ``envs_per_process``,
    ``step_timeout``, …) are accepted and have the same meaning.
    """

    name: str
    backend: str
    task: str
    num_workers: int = 1
    num_envs: int = 1
    max_episode_steps: int | None = None
    num_cpus: float = 1
    num_gpus: float = 0.0
    env_kwargs: Config = Field(default_factory=Config)

    @model_validator(mode="after")
    def _check_num_envs(self) -> Self:
        if self.num_envs > 1 and self.backend in _NOT_VECTORIZED:
            raise ValueError(f"num_envs must be 1: {self.backend!r} has no sub-environments")
        return self
