"""Scripts for RLightning, run by ``python -m rlightning_aio.legacy``.

The examples of RLightning's documentation run unchanged where its texts are next to the checkout
(``../shared/reference``); the scripts of this file run everywhere.
"""

from __future__ import annotations

import textwrap
from pathlib import Path

import pytest
from run_python import output_of

from rlightning_aio.plugins.legacy.names import is_rlightning_installed

pytestmark = pytest.mark.skipif(is_rlightning_installed(), reason="RLightning itself is installed")

TEXTS = Path(__file__).parents[2].parent / "shared" / "reference"


def check(script: Path, *arguments: str, folder: Path | None = None) -> str:
    command = ("-m", "rlightning_aio.legacy", script, *arguments)
    return output_of(*command, folder=folder or script.parent, asyncio_debug=False)


MODULE = """
import gymnasium as gym
import numpy as np

from rlightning.env.base_env import BaseEnv
from rlightning.types import EnvRet
from rlightning.utils.registry import ENVS


@ENVS.register("swing")
class SwingEnv(BaseEnv):
    def __init__(self, config, worker_index=0, preprocess_fn=None, **kwargs):
        super().__init__(config, worker_index, preprocess_fn)
        self.env = gym.make(config.task, g=config.gravity)

    def reset(self, *args, **kwargs):
        observation, info = self.env.reset(*args, **kwargs)
        return EnvRet(self.env_id, observation, info=info)

    def step(self, policy_resp):
        action = np.asarray(self._preprocess_fn(policy_resp))
        return EnvRet(self.env_id, *self.env.step(action))
"""
ENTRIES = """
imports:
  - my_swings
env:
  - {name: swing, backend: swing, task: Pendulum-v1, num_workers: 2, gravity: 5.0}
  - {name: swing, backend: swing, task: Pendulum-v1, max_episode_steps: 7, gravity: 9.0}
"""
SCRIPT = """
import os
import sys
import warnings

import numpy as np

from rlightning.types import BatchedData, PolicyResponse
from rlightning.utils.builders import build_env_group
from rlightning.utils.config import Config, EnvConfig
from rlightning.utils.registry import load_modules_from_config

warnings.simplefilter("ignore")
config = Config.load_yaml(sys.argv[1])
load_modules_from_config(config)
entries = [EnvConfig.from_dict(entry) for entry in config.env]
limit = float(sys.argv[2])


def clipped(policy_resp):
    return np.clip(policy_resp.action, -limit, limit)


def inverted(policy_resp: PolicyResponse):
    return -policy_resp.action


env_group = build_env_group(env_cfgs=entries, preprocess_fn=[clipped, inverted])
batch, _ = env_group.reset(seed=0)
action = np.ones(1, np.float32)
responses = [PolicyResponse(env_id=id_, action=action) for id_ in batch.ids()]
batch, _ = env_group.step(BatchedData(batch.ids(), responses))
slow, same, fast = (ret.observation.tolist() for ret in batch.values())
assert slow == same != fast
assert [env.config.gravity for env in env_group.env_list] == [5.0, 5.0, 9.0]
env_group.close()
print("ran as", __name__, os.path.isabs(__file__), sys.argv[1:])
"""


def test_a_script_runs_with_its_own_env_and_arguments(tmp_path: Path) -> None:
    """Its config names the env's module, and its preprocess functions run in workers."""
    (tmp_path / "my_swings.py").write_text(MODULE)
    (tmp_path / "entries.yaml").write_text(ENTRIES)
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    told = check(Path("script.py"), "entries.yaml", "0.5", folder=tmp_path)
    assert told == "ran as __main__ True ['entries.yaml', '0.5']\n"


@pytest.mark.parametrize(
    ("arguments", "said"), [(["missing.py"], "missing.py: no such file"), ([], "usage")]
)
def test_a_missing_script_is_named(arguments: list[str], said: str) -> None:
    """Without an argument, the usage is printed."""
    with pytest.raises(AssertionError, match=said):
        output_of("-m", "rlightning_aio.legacy", *arguments)


# -- the examples of RLightning's documentation

needs_texts = pytest.mark.skipif(
    not TEXTS.is_dir(), reason="RLightning's documentation is not next to this checkout"
)


class Text:
    """A page of the documentation, from which examples are cut."""

    def __init__(self, name: str) -> None:
        self._lines = (TEXTS / name).read_text().splitlines()

    def cut(self, first: str, last: str, skip: int = 0) -> str:
        """Return the lines from the one equal to `first` to the next one equal to `last`."""
        begin = -1
        for _ in range(skip + 1):
            begin = self._lines.index(first, begin + 1)
        return "\n".join(self._lines[begin : self._lines.index(last, begin) + 1]) + "\n"


def whole(*parts: str) -> str:
    """Return a program of these parts, each without its indentation."""
    return "\n".join(textwrap.dedent(p) if p.startswith("\n") else p for p in parts)


@needs_texts
def test_the_examples_on_custom_envs_run(tmp_path: Path) -> None:
    """They use preprocess functions, an env from a module that the YAML names, and MuJoCo."""
    text = Text("customize_env.txt")
    core = text.cut(
        "from rlightning.env.base_env import BaseEnv",
        "        action = self._preprocess_fn(policy_resp)",
    )
    step = text.cut(
        "        observation, reward, terminated, truncated, info = self.env.step(action)",
        "            last_truncated=truncated,",
    )
    my_env = core + step + "            info=info,\n        )\n"
    (tmp_path / "my_project").mkdir()
    simulator = """
        import gymnasium as gym

        class Simulated(MyEnv):
            def __init__(self, config, worker_index=0, preprocess_fn=None, **kwargs):
                super().__init__(config, worker_index, preprocess_fn)
                self.env = gym.make("Pendulum-v1")

        ENVS.module_dict["my_backend"] = Simulated
    """
    (tmp_path / "my_project" / "envs.py").write_text(whole(my_env, simulator))
    (tmp_path / "entries.yaml").write_text(text.cut("imports:", "    num_workers: 2"))
    (tmp_path / "entry.yaml").write_text(text.cut("env:", "    max_episode_steps: 200"))
    steps = """
        def go(env_group):
            env_group.init()
            batch, _ = env_group.reset(seed=0)
            space = env_group.get_action_spaces()[0]
            space.seed(0)
            rets = []
            for _ in range(3):
                action = space.sample()
                answers = [PolicyResponse(env_id=id_, action=action) for id_ in batch.ids()]
                batch, _ = env_group.step(BatchedData(batch.ids(), answers))
                rets += batch.values()
            env_group.close()
            return [ret.observation.tolist() for ret in rets]
    """
    script = tmp_path / "script.py"
    script.write_text(
        whole(
            text.cut("import numpy as np", "    return np.clip(action * 0.5, -1.0, 1.0)"),
            text.cut(
                "def default_env_preprocess_fn(policy_resp: PolicyResponse):",
                "    return policy_resp.action",
            ),
            """
            import warnings
            from rlightning.types import BatchedData
            from rlightning.utils.config import Config, EnvConfig
            from rlightning.utils.registry import load_modules_from_config

            warnings.simplefilter("ignore")
            task = dict(backend="mujoco", task="Hopper-v5", max_episode_steps=20)
            config = Config(env=[EnvConfig(name="hopper", **task)])
            """,
            steps,
            text.cut("from rlightning.utils.builders import build_env_group", ")"),
            """
            scaled = go(env_group)
            env_cfg_a, env_cfg_b = EnvConfig(name="a", **task), EnvConfig(name="b", **task)
            preprocess_fn_a, preprocess_fn_b = scaled_preprocess_fn, default_env_preprocess_fn
            """,
            text.cut("env_group = build_env_group(", ")", skip=1),
            """
            both = go(env_group)
            assert both[::2] == scaled
            assert both[1::2] != scaled
            """,
            text.cut(
                "from rlightning.env.base_env import BaseEnv", "            info=info,", skip=1
            )
            + "        )\n",
            """
            assert go(build_env_group(config.env)) == both[1::2]
            config = Config.load_yaml("entries.yaml")
            load_modules_from_config(config)
            assert len(go(build_env_group(config.env))) == 6
            assert Config.load_yaml("entry.yaml").env[0]["max_episode_steps"] == 200
            from rlightning.utils.registry import ENVS
            del ENVS.module_dict["my_backend"]
            """,
            text.cut("from rlightning.utils.registry import ENVS", "class MyEnv(BaseEnv):", skip=2)
            + "    ...\n",
            "class Described(BaseEnv):",
            textwrap.indent(
                text.cut(
                    "def __init__(self, config, worker_index=0, preprocess_fn=None, **kwargs):",
                    "    self.action_space = self.env.action_space",
                ),
                "    ",
            )
            + textwrap.indent(
                text.cut(
                    "def get_observation_space(self) -> gym.Space:",
                    "    return self.env.action_space",
                )
                + text.cut("def offload(self):", "    self._is_offloaded = False"),
                "    ",
            ),
            """
            class Whole(Described):
                _is_offloaded = False
                env_config = dict(id="Hopper-v5")
                clear_memory = reset = step = lambda self: None

            env = Whole(EnvConfig(name="whole", **task))
            assert env.get_observation_space().shape == (3, 128, 128)
            env.offload()
            assert env.env is None
            env.reload()
            assert env.get_action_space().shape == (3,)
            print("all of it")
            """,
        )
    )
    assert check(script) == "all of it\n"


@needs_texts
def test_the_examples_on_groups_run(tmp_path: Path) -> None:
    """They use the YAML, both loops, `auto_reset`, and a group's attributes."""
    text = Text("env_and_env_group.txt")
    (tmp_path / "entries.yaml").write_text(text.cut("envs:", "    num_workers: 4"))
    auto_reset = text.cut(
        "with env_group.auto_reset(max_episode_steps=100):",
        "        # truncations indicates which environments were auto-reset",
    )
    script = tmp_path / "script.py"
    script.write_text(
        whole(
            """
            import numpy as np
            from rlightning.types import BatchedData, PolicyResponse
            from rlightning.utils.config import Config

            config = Config.load_yaml("entries.yaml")
            max_rollout_steps = total_steps = 10
            transitions = []

            def env_preprocess_fn(policy_resp):
                return policy_resp.action

            class policy_group:
                @staticmethod
                def rollout_batch(batch):
                    action = np.zeros(6, np.float32)
                    answers = [PolicyResponse(env_id=id_, action=action) for id_ in batch.ids()]
                    return BatchedData(batch.ids(), answers)

            class buffer:
                @staticmethod
                def add_batched_transition(rets, answers):
                    transitions.extend(zip(rets.values(), answers.values(), strict=True))
            """,
            text.cut(
                "from rlightning.env import build_env_group",
                "env_group = build_env_group(config.envs, preprocess_fn=env_preprocess_fn)",
            ),
            text.cut("env_metas = env_group.init()", "env_metas = env_group.init()"),
            text.cut(
                "batched_env_ret, _ = env_group.reset(seed=0)",
                "    batched_env_ret, _ = env_group.step(batched_policy_resp)",
            ),
            "assert len(transitions) == 4 * max_rollout_steps",
            text.cut(
                "env_group.step_async(batched_policy_resp)",
                "batched_env_ret, truncations = env_group.collect_async()",
            ),
            "env_group.collect_async(wait_all=True)",
            auto_reset,
            "env_id = env_group.env_ids[0]",
            text.cut(
                "len(env_group)                       # Number of environments",
                "env_group.print_timing_summary()     # Print timing info",
            ),
            """
            assert env.get_env_id() == env_id
            assert (len(env_group), env_group.size()) == (4, 4)
            env_group.close()
            print("all of it")
            """,
        )
    )
    assert check(script).endswith("all of it\n")
