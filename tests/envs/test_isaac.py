"""The Isaac Lab backends on the real simulator, without Kit, on the CPU.

These tests run in the virtual environment of Isaac Lab (docs/isaac.md); `isaac_assets` has
robots and ground.
"""

from __future__ import annotations

import contextlib
import os
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from envs.isaac_bare import bare_simulator, by_agent

from rlightning_aio import BatchedData, sync
from rlightning_aio.config import EnvConfig
from rlightning_aio.errors import ConfigError
from rlightning_aio.types import EnvRet, MultiAgentEnvRet, PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rlightning_aio.envs.base import BaseEnv

torch: Any = pytest.importorskip("torch")
pytest.importorskip("isaaclab")

pytestmark = [
    pytest.mark.simulators,
    pytest.mark.timeout(600),  # The first run compiles kernels.
    pytest.mark.filterwarnings("default"),  # The simulator has deprecation warnings.
]

MANAGER_BASED = "Isaac-Cartpole"
MARL = "Isaac-Pendulum-MARL-Direct"
DOG = "Isaac-Velocity-{}-UnitreeGo2"
CARTPOLE_CFG = "isaaclab_tasks.core.cartpole.cartpole_manager_env_cfg::CartpoleEnvCfg"


@pytest.fixture(scope="module", autouse=True)
def _assets(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    from envs.isaac_assets import write_assets

    root: Path = write_assets(tmp_path_factory.mktemp("assets"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ISAACSIM_ASSET_ROOT", str(root))
        yield


@pytest.fixture
def make() -> Iterator[Any]:
    """Build envs; each is closed before the next one and after the test."""
    live: list[BaseEnv] = []

    def build(task: str = MANAGER_BASED, backend: str = "isaac_manager_based", **fields: Any):
        from rlightning_aio.envs.simulators.isaac import IsaacManagerBasedEnv, IsaacMarlEnv

        close()
        env_class = IsaacMarlEnv if backend == "isaac_marl" else IsaacManagerBasedEnv
        worker_index = fields.pop("worker_index", 0)
        env_kwargs = {"device": "cpu", **fields.pop("env_kwargs", {})}
        config = EnvConfig(
            name="isaac", backend=backend, task=task, env_kwargs=env_kwargs, **fields
        )
        live.append(env_class(config, worker_index))
        return live[-1]

    def close() -> None:
        while live:
            live.pop().close()

    yield build
    close()


def actions(num_steps: int, num_envs: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(num_steps, num_envs, 1)).astype(np.float32)


def respond(action: Any) -> PolicyResponse:
    return PolicyResponse("isaac-0", action=action)


def test_spaces_are_batched_and_contain_the_results(make: Any) -> None:
    """With 4 sub-environments every array has a first axis of 4 and is in its space."""
    env = make(num_envs=4)
    meta = env.init()
    assert meta.observation_space["policy"].shape == (4, 4)
    assert meta.action_space.shape == (4, 1)
    assert meta.max_episode_steps == 300
    first = env.reset(seed=0)
    then = env.step(respond(actions(1, 4)[0]))
    for ret in (first, then):
        assert isinstance(ret, EnvRet)
        observation = {group: tensor.numpy() for group, tensor in ret.observation.items()}
        assert meta.observation_space.contains(observation)
    assert then.last_reward.shape == (4,)
    assert then.last_reward.dtype == torch.float32
    assert then.last_terminated.dtype == then.last_truncated.dtype == torch.bool


def test_one_sub_environment_has_no_batch_axis(make: Any) -> None:
    """With num_envs 1 observations are single, and reward and flags Python scalars."""
    env = make(num_envs=1)
    meta = env.init()
    assert meta.observation_space["policy"].shape == (4,)
    assert meta.action_space.shape == (1,)
    env.reset(seed=0)
    ret = env.step(respond(np.zeros(1, np.float32)))
    assert ret.observation["policy"].shape == (4,)
    assert type(ret.last_reward) is float
    assert type(ret.last_terminated) is type(ret.last_truncated) is bool


def test_the_first_reset_is_like_every_other(make: Any) -> None:
    """The same seed gives the same observation, including new velocities, from the start."""
    env = make(num_envs=4)
    first, second = env.reset(seed=5).observation, env.reset(seed=5).observation
    assert torch.equal(first["policy"], second["policy"])
    assert first["policy"][:, 2:].abs().min() > 0
    assert not torch.equal(first["policy"], env.reset(seed=6).observation["policy"])


def test_marl_steps_equal_the_bare_simulators(make: Any) -> None:
    """200 steps of both agents, including resets, equal those of the bare simulator."""
    env = make(MARL, "isaac_marl", num_envs=3, max_episode_steps=40)
    steps = actions(200, 3)
    ours = [env.reset(seed=1)]
    ours += [env.step(respond(by_agent(a))) for a in steps]
    env.close()
    bare = bare_simulator(MARL, 3, 40)
    try:
        bare.reset(seed=1)
        observation, _ = bare.reset(seed=1)
        assert all(torch.equal(ours[0].observation[k], observation[k]) for k in observation)
        num_ended = 0
        for ret, action in zip(ours[1:], steps, strict=True):
            observation, reward, terminated, truncated, extras = bare.step(
                by_agent(torch.tensor(action))
            )
            for agent in ("cart", "pendulum"):
                assert torch.equal(ret.observation[agent], observation[agent])
                assert torch.equal(ret.last_reward[agent], reward[agent])
                assert torch.equal(ret.last_terminated[agent], terminated[agent])
                assert torch.equal(ret.last_truncated[agent], truncated[agent])
                if "final_obs" in ret.info:
                    final_obs = extras[agent]["final_obs"]
                    assert torch.equal(ret.info["final_obs"][agent], final_obs)
            ended = bool((terminated["cart"] | truncated["cart"]).any())
            assert ("final_obs" in ret.info) == ended
            num_ended += ended
        assert num_ended >= 3
    finally:
        bare.close()


def test_spaces_and_results_of_marl_are_dicts_by_agent(make: Any) -> None:
    """Each agent's values are batched."""
    env = make(MARL, "isaac_marl", num_envs=2)
    meta = env.init()
    assert meta.agents == ("cart", "pendulum")
    assert meta.observation_space["cart"].shape == (2, 4)
    assert meta.observation_space["pendulum"].shape == (2, 3)
    assert meta.action_space["pendulum"].shape == (2, 1)
    env.reset(seed=0)
    zeros = np.zeros((2, 1), np.float32)
    ret = env.step(respond({"cart": zeros, "pendulum": zeros}))
    assert isinstance(ret, MultiAgentEnvRet)
    assert ret.last_reward["cart"].shape == (2,)
    single = make(MARL, "isaac_marl", num_envs=1)
    single.reset(seed=0)
    ret = single.step(respond({"cart": zeros[0], "pendulum": zeros[0]}))
    assert ret.observation["pendulum"].shape == (3,)
    assert type(ret.last_terminated["cart"]) is bool


def test_results_are_never_overwritten(make: Any) -> None:
    """A step's result is unchanged after 60 more steps, including resets of sub-environments."""
    env = make(num_envs=2, max_episode_steps=20)
    env.reset(seed=0)
    kept: list[tuple[EnvRet, list[Any]]] = []
    for action in actions(60, 2):
        ret = env.step(respond(action))
        tensors = [*_tensors(ret)]
        kept.append((ret, [tensor.clone() for tensor in tensors]))
    for ret, copies in kept:
        assert all(torch.equal(a, b) for a, b in zip(_tensors(ret), copies, strict=True))


def _tensors(ret: EnvRet) -> Iterator[Any]:
    yield from (ret.observation["policy"], ret.last_reward)
    yield from (ret.last_terminated, ret.last_truncated)
    if "final_obs" in ret.info:
        yield ret.info["final_obs"]["policy"]


def test_torch_and_numpy_actions_have_the_same_effect(make: Any) -> None:
    """A tensor, an array and a read-only array."""
    env = make(num_envs=2)
    array = actions(1, 2)[0]
    frozen = array.copy()
    frozen.setflags(write=False)
    outcomes: list[Any] = []
    for action in (torch.tensor(array), array, frozen):
        env.reset(seed=0)
        outcomes.append(env.step(respond(action)).observation["policy"])
    assert torch.equal(outcomes[0], outcomes[1])
    assert torch.equal(outcomes[0], outcomes[2])


def test_a_second_live_env_is_refused(make: Any) -> None:
    """Isaac Lab has one env in a process: the error names the first, and closing it helps."""
    from rlightning_aio.envs.simulators.isaac import IsaacManagerBasedEnv

    first = make(num_envs=2)
    second = EnvConfig(
        name="other", backend="isaac_manager_based", task=MANAGER_BASED, num_envs=2,
        env_kwargs={"device": "cpu"},
    )  # fmt: skip
    with pytest.raises(ConfigError, match=r"other-0.*one live env.*isaac-0.*envs_per_process"):
        IsaacManagerBasedEnv(second)
    first.close()
    env = IsaacManagerBasedEnv(second)
    env.close()
    env.close()


def test_a_configuration_class_with_overrides(make: Any) -> None:
    """`module::Class` builds that configuration, with dotted and nested fields changed."""
    overrides = {
        "events.reset_cart_position.params.position_range": [2.0, 2.0],
        "sim": {"dt": 0.01},
        "episode_length_s": 1.0,
    }
    env = make(CARTPOLE_CFG, num_envs=2, env_kwargs={"overrides": overrides})
    assert env.env.cfg.sim.dt == 0.01
    assert env.max_episode_steps == 50
    assert env.reset(seed=0).observation["policy"][:, 0].tolist() == pytest.approx([2.0, 2.0])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"task": "Isaac-Cartpol"}, r"isaac-0: task 'Isaac-Cartpol'.*did you mean 'Isaac-Cart"),
        ({"task": "nowhere::Cfg"}, r"isaac-0: task: 'nowhere::Cfg' can't be loaded"),
        ({"env_kwargs": {"devize": "cpu"}}, r"isaac-0: env_kwargs\.devize.*device"),
        ({"env_kwargs": {"overrides": {"sim.td": 1}}}, r"overrides\.sim\.td: there is no 'td'"),
        (
            {"task": CARTPOLE_CFG, "backend": "isaac_marl"},
            r"isaac-0: .*env_kwargs\.env_class",
        ),
    ],
)
def test_faults_of_the_config_are_named(make: Any, fields: Any, message: str) -> None:
    """A task, option or override that doesn't exist; the process can build another env."""
    with pytest.raises(ConfigError, match=message):
        make(**fields)
    make(num_envs=1)


def walk(env: BaseEnv) -> Any:
    """Return the observations of a seeded reset and of ten steps."""
    start = env.reset(seed=3)
    steps = [env.step(respond(action)) for action in actions(10, 2 * 12).reshape(10, 2, 12)]
    return torch.stack([ret.observation["policy"] for ret in (start, *steps)])


def test_another_task_walks_on_rough_ground(make: Any) -> None:
    """A dog sees the generated terrain; the same seed repeats it."""
    overrides = {
        "seed": 7,
        "scene.terrain.terrain_generator": {"num_rows": 1, "num_cols": 2},
        "commands.base_velocity.debug_vis": False,
    }
    walks = []
    for _ in range(2):
        env = make(DOG.format("Rough"), num_envs=2, env_kwargs={"overrides": overrides})
        walks.append(walk(env))
        assert walks[-1][0].numpy() in env.get_observation_space()["policy"]
        height_scan = walks[-1][..., 48:]
        assert height_scan.shape[-1] == 187
        assert height_scan.std() > 0.01
    assert torch.equal(*walks)


def test_values_drawn_at_the_start_depend_on_the_seed(make: Any) -> None:
    """Startup events draw the masses of the dogs; they differ between envs."""
    masses, walks = [], []
    for worker_index in (0, 0, 1):
        env = make(
            DOG.format("Flat"), num_envs=2, worker_index=worker_index,
            env_kwargs={"overrides": {"seed": 7, "commands.base_velocity.debug_vis": False}},
        )  # fmt: skip
        walks.append(walk(env))
        masses.append(env.env.scene["robot"].data.body_mass.torch.clone())
    assert torch.equal(masses[0], masses[1])
    assert torch.equal(walks[0], walks[1])
    assert not torch.equal(masses[0], masses[2])


def test_assets_come_from_a_server(tmp_path: Path) -> None:
    """ISAACSIM_ASSET_ROOT may be a URL, as in the configurations of all tasks."""
    with serving(Path(os.environ["ISAACSIM_ASSET_ROOT"])) as (url, paths):
        entry = {
            "name": "isaac",
            "backend": "isaac_manager_based",
            "task": MANAGER_BASED,
            "num_envs": 2,
            "start_timeout": 300.0,
            # Downloads are kept among the temporary files.
            "env_vars": {"ISAACSIM_ASSET_ROOT": url, "TMPDIR": str(tmp_path)},
            "env_kwargs": {"device": "cpu"},
        }
        with sync.build_env_group(entry) as group:
            group.reset(seed=0)
    assert any(path.endswith("cartpole.usd") for path in paths)


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield the URL of an HTTP server for `folder`, and the requested paths."""
    paths: list[str] = []

    class Handler(SimpleHTTPRequestHandler):
        def log_request(self, *args: Any) -> None:
            paths.append(self.path)

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", paths
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.mark.parametrize("placement", ["inline", "process"])
def test_tensors_stay_tensors_inline_and_are_arrays_from_a_process(placement: str) -> None:
    """Inline observations are torch tensors; from a worker they are equal NumPy arrays."""
    entry = {
        "name": "isaac",
        "backend": "isaac_manager_based",
        "task": MANAGER_BASED,
        "num_envs": 2,
        "placement": placement,
        **({"start_timeout": 300.0} if placement == "process" else {}),
        "env_kwargs": {"device": "cpu"},
    }
    action = actions(1, 2)[0]
    with sync.build_env_group(entry) as group:
        group.reset(seed=0)
        outcomes = []
        for given in (torch.tensor(action), action):
            group.reset(seed=0)
            batch, _ = group.step(BatchedData(["isaac-0"], [respond(given)]))
            outcomes.append(batch["isaac-0"])
        kind = torch.Tensor if placement == "inline" else np.ndarray
        for ret in outcomes:
            assert isinstance(ret.observation["policy"], kind)
            assert isinstance(ret.last_reward, np.ndarray)
        first, second = (np.asarray(ret.observation["policy"]) for ret in outcomes)
        np.testing.assert_array_equal(first, second)
