"""RLightning's configs: mutable, open to extra fields, and readable like dicts."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self, cast

import yaml
from omegaconf import OmegaConf
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

if TYPE_CHECKING:
    import os

__all__ = ["Config", "EnvConfig"]

_BACKENDS: Final = (
    "ale", "maniskill", "mujoco", "piper", "env_server", "isaac_marl", "isaac_manager_based",
)  # fmt: skip
_VECTORIZED: Final = ("maniskill", "isaac_manager_based", "isaac_marl")
_CONTROL_MODES: Final = {
    "google_robot_static": "arm_pd_ee_delta_pose_align_interpolate_by_planner"
    "_gripper_pd_joint_pos_interpolate_by_planner",
    "widowx": "arm_pd_ee_target_delta_pose_align2_gripper_pd_joint_pos",
}
"""ManiSkill's control modes, by the robot that `policy_setup` names."""


class Config(BaseModel):
    """A section of a config; mappings among its extra fields become sections, too."""

    model_config = ConfigDict(extra="allow", frozen=False)

    @model_validator(mode="after")
    def _make_sections_of_mappings(self) -> Self:
        for name, value in (self.model_extra or {}).items():
            if isinstance(value, dict):
                setattr(self, name, Config.from_dict(cast("dict[str, Any]", value)))
        return self

    def __getitem__(self, name: str) -> Any:
        return getattr(self, name)

    def get(self, name: str, default: Any = None) -> Any:
        """Return the field `name`, or `default`."""
        return getattr(self, name, default)

    @classmethod
    def load_yaml(cls, file_path: str | os.PathLike[str] | None = None) -> Self:
        """Read a YAML file; without one, return all defaults."""
        text = "{}" if file_path is None else Path(file_path).read_text(encoding="utf-8")
        return cls.from_dict(yaml.safe_load(text))

    @classmethod
    def from_omegaconf(cls, om_cfg: Any) -> Self:
        """Make a config of an OmegaConf node, which is resolved first."""
        return cls.from_dict(cast("dict[str, Any]", OmegaConf.to_container(om_cfg, resolve=True)))

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """Make a config of a mapping.

        Raises:
            ValueError: fields are wrong; the message has a line for each.
        """
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            faults = "".join(
                f"\n  field '{'.'.join(map(str, fault['loc']))}': {fault['msg']}"
                for fault in error.errors()
            )
            raise ValueError(f"{cls.__name__} has wrong fields:{faults}") from error

    def to_dict(self) -> dict[str, Any]:
        """Return the config as nested plain dicts."""
        return self.model_dump()

    def to_yaml(self) -> str:
        """Return `to_dict` as YAML."""
        return yaml.safe_dump(self.to_dict(), sort_keys=False)


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
    init_params: Config | None = None
    policy_setup: str = "widowx"
    evaluate_cfg: Config | None = None

    @model_validator(mode="after")
    def _check_backend(self) -> Self:
        if self.backend not in _BACKENDS:
            warnings.warn(
                f"backend {self.backend!r} is not one of RLightning's ({', '.join(_BACKENDS)}); it "
                "must be registered by the program",
                stacklevel=2,
            )
        elif self.num_envs > 1 and self.backend not in _VECTORIZED:
            raise ValueError(
                "Vectorized environments are only supported by "
                f"{', '.join(_VECTORIZED)}, not by {self.backend!r}"
            )
        return self

    @model_validator(mode="after")
    def _choose_control_mode(self) -> Self:
        if "maniskill" not in self.backend or self.init_params is None:
            return self
        for robot, mode in _CONTROL_MODES.items():
            if robot in self.policy_setup:
                self.init_params = self.init_params.model_copy(update={"control_mode": mode})
                return self
        raise NotImplementedError(
            f"no control mode is known for policy_setup {self.policy_setup!r}; known: "
            f"{', '.join(_CONTROL_MODES)}"
        )
