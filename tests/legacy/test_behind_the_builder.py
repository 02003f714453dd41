"""RLightning's own builder and values with our groups, where RLightning is installed.

RLightning needs gigabytes of other packages, so this test writes a package of the modules that
matter, with classes of its own. tests/peers/run.py uses the real one.
"""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

from run_python import output_of

if TYPE_CHECKING:
    from pathlib import Path

MODULES = {
    "__init__": "from . import env, types, utils",
    "types": """
        from rlightning_aio.plugins.legacy import types as like

        class EnvRet(like.EnvRet): ...
        class PolicyResponse(like.PolicyResponse): ...
        class BatchedData(like.BatchedData): ...
    """,
    "env/__init__": "from .base_env import BaseEnv\nfrom .env_group import EnvGroup",
    "env/base_env": "from rlightning_aio.plugins.legacy.env import BaseEnv",
    "env/env_group": """
        class EnvGroup:
            def __init__(self, env_cfg_list, preprocess_fn):
                raise NotImplementedError("RLightning's own group")
    """,
    "env/utils/__init__": "",
    "env/utils/utils": """
        def default_env_preprocess_fn(policy_resp):
            return policy_resp.action
    """,
    "env/remote_env/__init__": "",
    "env/remote_env/env_client": "class RemoteEnvClient: ...",
    "engine": """
        class Engine:
            def __init__(self, env_group):
                self.env_group = env_group

            def rollout(self, steps):
                from rlightning.types import BatchedData, EnvRet, PolicyResponse

                rets = []
                with self.env_group.auto_reset(max_episode_steps=2):
                    batch, _ = self.env_group.reset(seed=0)
                    for _ in range(steps):
                        assert type(batch) is BatchedData
                        rets += batch.values()
                        answers = [PolicyResponse(id_, action=[1.0]) for id_ in batch.ids()]
                        batch, _ = self.env_group.step(BatchedData(batch.ids(), answers))
                assert all(type(ret) is EnvRet for ret in rets)
                return rets
    """,
    "utils/__init__": "",
    "utils/config": """
        from rlightning_aio.plugins.legacy import config as like

        class EnvConfig(like.EnvConfig): ...
    """,
    "utils/registry": """
        from rlightning_aio.plugins.legacy.registry import Registry

        ENVS = Registry("environments")
    """,
    "utils/builders": """
        from rlightning.env.env_group import EnvGroup
        from rlightning.env.utils.utils import default_env_preprocess_fn

        def build_env_group(env_cfgs, preprocess_fn=default_env_preprocess_fn):
            configs = [config for config in env_cfgs for _ in range(config.num_workers)]
            return EnvGroup(env_cfg_list=configs, preprocess_fn=[preprocess_fn] * len(configs))
    """,
}
SCRIPT = """
import warnings

import numpy as np
import rlightning.env
from rlightning.engine import Engine
from rlightning.env import BaseEnv
from rlightning.env.remote_env.env_client import RemoteEnvClient
from rlightning.types import EnvRet
from rlightning.utils.builders import build_env_group
from rlightning.utils.config import EnvConfig
from rlightning.utils.registry import ENVS

warnings.simplefilter("ignore")


@ENVS.register("mine")
class Mine(BaseEnv):
    def reset(self, seed=None):
        self.count = 0
        return EnvRet(self.env_id, np.zeros(1), info={"seed": seed})

    def step(self, policy_resp):
        assert type(policy_resp).__module__ == "rlightning.types"
        self.count += 1
        return EnvRet(self.env_id, np.full(1, float(self.count)), 1.0, _extra={"kept": True})


group = build_env_group([EnvConfig(name="m", backend="mine", task="any", num_workers=2)])
assert type(group) is rlightning.env.EnvGroup
assert type(group).__module__ == "rlightning_aio.plugins.legacy.group"
assert RemoteEnvClient.__module__ == "rlightning_aio.plugins.legacy.remote"
rets = Engine(group).rollout(5)
assert [ret.observation[0] for ret in rets[::2]] == [0, 1, 2, 0, 1]
assert [ret.info.get("seed", "none") for ret in rets[::2]] == [0, "none", "none", None, "none"]
assert rets[2]._extra["kept"]
group.close()
print("with", rlightning.__file__)
"""


def test_rlightnings_engine_gets_rlightnings_values_from_our_group(tmp_path: Path) -> None:
    """So do its envs in workers; its own group is never made."""
    for name, text in MODULES.items():
        file = tmp_path / "rlightning" / f"{name}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(textwrap.dedent(text))
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    printed = output_of("-m", "rlightning_aio.legacy", script, asyncio_debug=False)
    assert printed == f"with {tmp_path / 'rlightning' / '__init__.py'}\n"
