"""RLightning's names, where RLightning is not installed."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING, Any

import pytest
from patience import HANG

from rlightning_aio.legacy import install
from rlightning_aio.plugins.legacy.names import is_rlightning_installed

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.skipif(is_rlightning_installed(), reason="RLightning itself is installed")


@pytest.fixture(autouse=True)
def _installed() -> None:
    install()


def test_importing_rlightning_aio_does_not_import_legacy() -> None:
    """Its names are made on first use."""
    program = "import rlightning_aio, sys; print([m for m in sys.modules if 'legacy' in m])"
    found = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=HANG, check=True
    )
    assert found.stdout.strip() == "[]"


def test_every_name_of_the_table_can_be_imported() -> None:
    """Each path has all of its names, and each name is one object."""
    import importlib

    from rlightning_aio.plugins.legacy.finder import ALIASED

    for path, homes in ALIASED.items():
        module = importlib.import_module(path)
        for names in homes.values():
            for name in names:
                assert getattr(module, name) is getattr(module, name)
    import rlightning

    assert rlightning.__version__
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


def test_results_are_built_by_position_and_converted() -> None:
    """An `EnvRet` has RLightning's order of fields, its methods and its hash."""
    import numpy as np
    from rlightning.types import EnvRet

    ret = EnvRet("env", np.zeros(2), 1.5, True, _extra={"value": 3})
    assert (ret.last_reward, ret.last_terminated, ret.last_truncated) == (1.5, True, False)
    assert set(EnvRet.fields()) | {"value"} == ret.to_dict().keys()
    assert EnvRet.get_defaults()["last_reward"] == 0.0
    assert ret.numpy().observation is not None
    assert hash(ret) == hash("env")
    assert ret.compute_sent_latency(ret.ts_env_sent_ns + 1_000_000_000) == 1.0
    ret._extra["info"] = 1
    with pytest.raises(KeyError, match="info"):
        ret.to_dict()


def test_responses_hold_any_data_and_can_be_pickled() -> None:
    """An action is optional."""
    import pickle

    from rlightning.types import MultiAgentPolicyResponse, PolicyResponse

    response = PolicyResponse(env_id="env", actions=[1, 2], log_prob=0.5)
    assert pickle.loads(pickle.dumps(response)) == response
    assert response.to_dict() == {"actions": [1, 2], "log_prob": 0.5}
    assert response.mark_policy_sent().compute_sent_latency() >= 0.0
    assert response.cpu().to_dict().keys() == {"actions", "log_prob"}
    agents = MultiAgentPolicyResponse.make_example({"a": _space()}, env_id="env")
    assert agents.action["a"] in _space()


def _space() -> Any:
    import gymnasium as gym

    return gym.spaces.Discrete(3)


def test_batches_hold_tuples() -> None:
    """Arguments are named `ids` and `data`; a missing id raises ValueError."""
    from rlightning.types import BatchedData

    batch = BatchedData(ids=["a", "b", "a"], data=[1, 2, 3])
    assert (batch.ids(), batch.values()) == (("a", "b", "a"), (1, 2, 3))
    assert (batch["a"], len(batch), batch.is_future) == (1, 3, False)
    assert list(batch) == list(batch.items()) == [("a", 1), ("b", 2), ("a", 3)]
    assert BatchedData.from_dict({"c": 4}).ids() == ("c",)
    with pytest.raises(ValueError, match="not in tuple"):
        batch["z"]
    with pytest.raises(ValueError, match="1 ids for 0"):
        BatchedData(["a"], [])


def test_configs_are_mutable_open_and_nested(tmp_path: Path) -> None:
    """Extra mappings become sections; fields can be read as attributes, items, or with `get`."""
    from omegaconf import OmegaConf
    from rlightning.utils.config import EnvConfig

    fields = {"name": "one", "backend": "mujoco", "task": "Hopper-v5", "video": {"fps": {"max": 3}}}
    config = EnvConfig.from_omegaconf(OmegaConf.create(fields))
    config.num_workers = 3
    assert config.video.fps.max == 3
    assert (config["num_workers"], config.get("seed", 7)) == (3, 7)
    assert config.to_dict()["video"] == {"fps": {"max": 3}}
    file = tmp_path / "entry.yaml"
    file.write_text(config.to_yaml())
    assert EnvConfig.load_yaml(file) == config
    with pytest.raises(ValueError, match="field 'task'"):
        EnvConfig.from_dict({"name": "one", "backend": "mujoco"})
    with pytest.raises(ValueError, match="Vectorized"):
        EnvConfig(name="one", backend="mujoco", task="Hopper-v5", num_envs=2)
    with pytest.warns(UserWarning, match="'mine'"):
        EnvConfig(name="one", backend="mine", task="Hopper-v5", num_cpus=0.5)


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


def test_step_counts_begin_at_minus_one() -> None:
    """They are 0 after the first reset; a step beyond the limit raises."""
    from rlightning.env.env_group import EnvStepCounter

    counter = EnvStepCounter(["a", "b"], [1, 5])
    assert counter["a"] == counter.get_steps("a") == -1
    counter.step_all()
    counter.step("a")
    assert counter.get_truncations(["b", "a"]) == [False, True]
    with pytest.raises(ValueError, match="a"):
        counter.step("a")
    counter.reset_all()
    assert counter["b"] == -1
    with pytest.raises(ValueError, match="one limit"):
        EnvStepCounter(["a"], [1, 2])


def test_flags_are_read_from_environment_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each access reads the variable again."""
    from rlightning.utils.utils import InternalFlag

    monkeypatch.setenv("RLIGHTNING_REMOTE_ENV", "1")
    assert InternalFlag.REMOTE_ENV
    assert not InternalFlag.DEBUG
    assert InternalFlag.get_env_vars()["RLIGHTNING_REMOTE_ENV"] == "1"
    with pytest.raises(AttributeError, match="REMOTE_CAFE"):
        InternalFlag.REMOTE_CAFE  # noqa: B018


def test_timers_add_up_durations_of_methods() -> None:
    """The sums are in the object's `timing_raw`."""
    from rlightning.utils.profiler import profiler

    class Timed:
        @profiler.timer_wrap(level="debug")
        def method(self) -> str:
            return "done"

    timed: Any = Timed()
    assert timed.method() == timed.method() == "done"
    assert timed.timing_raw["method"]["count"] == 2
