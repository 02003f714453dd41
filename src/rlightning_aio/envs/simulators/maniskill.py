"""`maniskill`: manipulation tasks of ManiSkill 3, one on the CPU or many on a GPU.

Rule: results are torch tensors on the simulator's device, and copies, because it reuses
its buffers. At ``num_envs: 1`` they lose their batch axis, so that a group sees a single
env whatever simulates it.
Absent on purpose: batches on the CPU, which ManiSkill doesn't have; use more workers.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from rlightning_aio.envs.base import BaseEnv, sub_env_seeds
from rlightning_aio.envs.simulators.vulkan import do_without_materials, render_device_is_usable
from rlightning_aio.errors import ConfigError
from rlightning_aio.trees import as_numpy, is_tensor, mapped
from rlightning_aio.types import EnvRet, PolicyResponse

if TYPE_CHECKING:
    from rlightning_aio.config import EnvConfig

if not render_device_is_usable():
    do_without_materials()
# Optional and untyped, so imported by name; importing mani_skill.envs registers the tasks.
torch: Any = import_module("torch")
import_module("mani_skill.envs")
find_max_episode_steps: Any = import_module(
    "mani_skill.utils.gym_utils"
).find_max_episode_steps_value

MODES_WITHOUT_RENDERING = (None, "none", "state", "state_dict")


class ManiskillEnv(BaseEnv):
    """One task, or ``num_envs`` of it on a GPU; ``env_kwargs`` go to `gymnasium.make`.

    With ``num_envs: 1`` observations fit the task's single observation space, rewards and
    flags are Python scalars, and so are the one-element tensors of the info. Above that
    everything is a tensor ``[num_envs, ...]`` on the GPU.

    ``info["success"]`` and ``info["fail"]`` are the task's verdict on each step. Ended
    sub-environments continue until they are reset; ``reset(options={"env_idx": [2, 5]})``
    resets those alone, and ``{"reconfigure": True}`` rebuilds the scene.

    Raises:
        ConfigError: ``num_envs`` above 1 without a GPU to simulate on, images without a
            Vulkan device, or a task whose assets have not been downloaded.
    """

    def __init__(self, config: EnvConfig, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self._make_kwargs: dict[str, Any] = {
            "num_envs": self.num_envs,
            "max_episode_steps": config.max_episode_steps,
            # Otherwise resets without a seed draw from torch's global generator, which
            # whatever shares the process draws from as well.
            "enhanced_determinism": True,
            **self._simulation_arguments(),
            **self._render_arguments(),
        }
        # Without a seed, ManiSkill seeds every env with the same number.
        self._unseeded = np.random.default_rng()
        self._open()
        self.max_episode_steps = find_max_episode_steps(self.env)
        self._spaces = self._read_spaces()

    def _simulation_arguments(self) -> dict[str, Any]:
        """Return the user's ``env_kwargs``, after checking that they allow ``num_envs``."""
        given = self.config.env_kwargs
        if self.num_envs > 1:
            backend = str(given.get("sim_backend", "auto"))
            if backend in ("cpu", "physx_cpu") or not torch.cuda.is_available():
                reason = "no CUDA device is usable here" if backend == "auto" else backend
                raise ConfigError(
                    f"env {self.env_id!r}: num_envs is {self.num_envs}, but ManiSkill batches "
                    f"only on a GPU (sim_backend: {reason}); set num_envs: 1 and num_workers: "
                    f"{self.num_envs}"
                )
        return given

    def _render_arguments(self) -> dict[str, Any]:
        """Return arguments that turn the renderer off if there is no device for it."""
        if render_device_is_usable():
            return {}
        given = self.config.env_kwargs
        if given.get("obs_mode") not in MODES_WITHOUT_RENDERING or given.get("render_mode"):
            raise ConfigError(
                f"env {self.env_id!r}: env_kwargs ask for images, but no Vulkan device is usable "
                "here; install a GPU's driver or a recent Mesa (see docs/simulators.md), or use "
                "obs_mode: state without a render_mode"
            )
        return {"render_backend": "none"}

    def _open(self) -> None:
        try:
            self.env = gym.make(self.config.task_name, **self._make_kwargs)
        except (EOFError, SystemExit) as error:
            # ManiSkill asks at the terminal whether to download what is missing, and exits
            # the interpreter on any answer but yes.
            raise ConfigError(
                f"env {self.env_id!r}: the assets of {self.config.task_name} are not on this "
                f"machine; `python -m mani_skill.utils.download_asset {self.config.task_name}` "
                "fetches them"
            ) from error
        self._is_offloaded = False
        self._is_seeded = False

    def _read_spaces(self) -> tuple[gym.Space[Any], gym.Space[Any]]:
        if self.num_envs > 1:
            return self.env.observation_space, self.env.action_space
        task = self.env.unwrapped
        return task.single_observation_space, task.single_action_space

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        """Reset all sub-environments, or those in ``options["env_idx"]``.

        A seed sets the generators of all of them, also in a partial reset.

        Raises:
            RuntimeError: the env is offloaded.
        """
        self._require_loaded()
        observation, info = self.env.reset(
            seed=self._seeds(seed), options=self._reset_options(options)
        )
        return EnvRet(
            env_id=self.env_id,
            observation=self._handed_out(observation),
            info=self._handed_out(info, scalars=True),
        )

    def _seeds(self, seed: int | list[int] | None) -> list[int] | None:
        if seed is not None:
            seeds = sub_env_seeds(self, seed)
            self._unseeded = np.random.default_rng(seeds)
        elif not self._is_seeded:
            seeds = self._unseeded.integers(2**31, size=self.num_envs).tolist()
        else:
            return None
        self._is_seeded = True
        return seeds

    def _reset_options(self, options: dict[str, Any] | None) -> dict[str, Any]:
        options = dict(options or {})
        if "env_idx" in options:
            device = self.env.unwrapped.device
            options["env_idx"] = torch.as_tensor(options["env_idx"], device=device)
        return options

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        """Advance every sub-environment.

        Raises:
            RuntimeError: the env is offloaded.
        """
        self._require_loaded()
        action = self._preprocess_fn(policy_resp)
        if not is_tensor(action) and not isinstance(action, dict):
            # Torch warns of sharing memory that it may not write to.
            action = np.require(action, requirements="W")
        observation, reward, terminated, truncated, info = self.env.step(action)
        return EnvRet(
            env_id=self.env_id,
            observation=self._handed_out(observation),
            last_reward=self._handed_out(reward, scalars=True),
            last_terminated=self._handed_out(terminated, scalars=True),
            last_truncated=self._handed_out(truncated, scalars=True),
            info=self._handed_out(info, scalars=True),
        )

    def _handed_out(self, value: Any, *, scalars: bool = False) -> Any:
        """Copy a value from the simulator, without the batch axis if there is one env.

        Args:
            value: tensors with a leading batch axis, in dicts to any depth.
            scalars: convert one number of one env to a Python scalar.
        """

        def own(one: Any) -> Any:
            if not is_tensor(one):
                return one
            if self.num_envs > 1:
                return one.clone()
            return one.item() if scalars and one.ndim == 1 else one[0].clone()

        return mapped(own, value)

    def _require_loaded(self) -> None:
        if self._is_offloaded:
            raise RuntimeError(f"env {self.env_id!r} is offloaded: reload() it, then reset it")

    def get_observation_space(self) -> gym.Space[Any]:
        return self._spaces[0]

    def get_action_space(self) -> gym.Space[Any]:
        return self._spaces[1]

    def render(self) -> Any:
        """Return frames ``[height, width, 3]`` uint8, with a leading ``num_envs`` if vectorised."""
        self._require_loaded()
        return as_numpy(self._handed_out(self.env.render()))

    def offload(self) -> None:
        """Close the simulator and give its device memory back; the episode is lost."""
        if self._is_offloaded:
            return
        self._is_offloaded = True
        self.close()
        self.clear_memory()

    def reload(self) -> None:
        """Make the simulator again; reset it before the next step."""
        if self._is_offloaded:
            self._open()

    def close(self) -> None:
        env, self.env = self.env, None
        if env is not None:
            env.close()
