"""RLightning's names, where RLightning is not installed."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from run_python import output_of

from rlightning_aio.legacy import install
from rlightning_aio.plugins.legacy.names import ALIASED, is_rlightning_installed

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.skipif(is_rlightning_installed(), reason="RLightning itself is installed")


@pytest.fixture(autouse=True)
def _installed() -> None:
    install()


def test_importing_rlightning_aio_does_not_import_legacy() -> None:
    """Its names are made on first use."""
    program = "import rlightning_aio, sys; print([m for m in sys.modules if 'legacy' in m])"
    assert output_of("-c", program).strip() == "[]"


def test_every_name_of_the_table_can_be_imported() -> None:
    """Each path has all of its names, and each name is one object."""
    import importlib

    for path, homes in ALIASED.items():
        module = importlib.import_module(path)
        for name in homes:
            assert getattr(module, name) is getattr(module, name)
    import rlightning

    assert rlightning.env.EnvGroup is rlightning.env.env_group.EnvGroup


@pytest.mark.parametrize(
    "statement",
    [
        "import rlightning.engine",
        "from rlightning import policy",
        "from rlightning.buffer import DataBuffer",
        "from rlightning.utils.builders import build_engine",
        "from rlightning.utils.builders import build_policy_group",
        "from rlightning.utils.builders import build_data_buffer",
        "from rlightning.env.libero_env import LiberoEnv",
        "from rlightning.utils.config import MainConfig",
        "from rlightning.utils.launch import launch",
        "from rlightning.utils.ray import TaskSubmitter",
        "from rlightning.utils.registry import POLICIES",
        "from rlightning.utils.profiler import profiler",
    ],
)
def test_a_name_that_only_rlightning_has_raises_an_import_error(statement: str) -> None:
    """The message has the reason and the remedy."""
    with pytest.raises(ImportError, match="belongs to RLightning, which is not installed"):
        exec(statement)


def test_hasattr_of_a_missing_name_is_false() -> None:
    """Pickling a function looks for its name in every module."""
    import rlightning.types

    assert not hasattr(rlightning.types, "no_such_thing")


def test_results_are_built_by_position() -> None:
    """An `EnvRet` has RLightning's order of fields."""
    import numpy as np
    from rlightning.types import EnvRet

    ret = EnvRet("env", np.zeros(2), 1.5, True, _extra={"value": 3})
    assert (ret.last_reward, ret.last_terminated, ret.last_truncated) == (1.5, True, False)
    assert (ret.info, ret._extra) == ({}, {"value": 3})


def test_responses_hold_any_data_and_can_be_pickled() -> None:
    """An action is optional."""
    import pickle

    from rlightning.types import PolicyResponse

    response = PolicyResponse(env_id="env", actions=[1, 2], log_prob=0.5)
    assert pickle.loads(pickle.dumps(response)) == response
    assert response.to_dict() == {"actions": [1, 2], "log_prob": 0.5}


def test_batches_hold_tuples() -> None:
    """Arguments are named `ids` and `data`; a missing id raises ValueError."""
    from rlightning.types import BatchedData

    batch = BatchedData(ids=["a", "b", "a"], data=[1, 2, 3])
    assert (batch.ids(), batch.values()) == (("a", "b", "a"), (1, 2, 3))
    assert (batch["a"], len(batch)) == (1, 3)
    assert list(batch) == list(batch.items()) == [("a", 1), ("b", 2), ("a", 3)]
    with pytest.raises(ValueError, match="not in tuple"):
        batch["z"]
    with pytest.raises(ValueError, match="1 ids for 0"):
        BatchedData(["a"], [])


def test_configs_are_mutable_open_and_nested(tmp_path: Path) -> None:
    """Extra mappings become sections; fields can be read as attributes, or with `get`."""
    from rlightning.utils.config import EnvConfig

    fields = {"name": "one", "backend": "mujoco", "task": "Hopper-v5", "video": {"fps": {"max": 3}}}
    config = EnvConfig.from_dict(fields)
    config.num_workers = 3
    assert config.video.fps.max == 3
    assert (config.get("num_workers"), config.get("seed", 7)) == (3, 7)
    assert config.to_dict()["video"] == {"fps": {"max": 3}}
    file = tmp_path / "entry.yaml"
    file.write_text(json.dumps(config.to_dict()))
    assert EnvConfig.load_yaml(file) == config
    with pytest.raises(ValueError, match="task"):
        EnvConfig.from_dict({"name": "one", "backend": "mujoco"})
    with pytest.raises(ValueError, match="no sub-environments"):
        EnvConfig(name="one", backend="mujoco", task="Hopper-v5", num_envs=2)


def test_a_registry_accepts_a_name_once() -> None:
    """The default is the name of the class; a built-in env may be replaced."""
    from rlightning.utils.registry import ENVS, Registry

    registry = Registry("toys")

    @registry.register()
    class Toy: ...

    assert registry.get("Toy") is registry.module_dict["Toy"] is Toy
    with pytest.raises(KeyError, match="already registered"):
        registry.register("Toy")(Toy)
    with pytest.raises(KeyError, match="no_toy is not in the toys registry"):
        registry.get("no_toy")
    assert {"mujoco", "ale", "maniskill", "piper"} <= ENVS.module_dict.keys()


def test_flags_are_read_from_environment_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each access reads the variable again."""
    from rlightning.utils.utils import InternalFlag

    monkeypatch.setenv("RLIGHTNING_REMOTE_ENV", "1")
    assert InternalFlag.REMOTE_ENV
    assert not InternalFlag.DEBUG
    with pytest.raises(AttributeError, match="REMOTE_CAFE"):
        InternalFlag.REMOTE_CAFE  # noqa: B018
