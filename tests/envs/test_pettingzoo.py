"""The `pettingzoo` backend on real multi-agent environments, and on small awkward ones."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pytest
from envs.group_contract import NO_LIMIT, GroupContract
from gymnasium.spaces import Box, Dict, Discrete, Tuple

from rlightning_aio import sync
from rlightning_aio.config import EnvConfig
from rlightning_aio.errors import ConfigError
from rlightning_aio.evaluation import evaluate
from rlightning_aio.policies.random_actions import RandomPolicy
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from kit.contract import Expected

    from rlightning_aio.envs.simulators.pettingzoo import PettingZooEnv
    from rlightning_aio.types import MultiAgentEnvRet

pytest.importorskip("pettingzoo")
pytest.importorskip("mpe2")
import pettingzoo
from mpe2 import simple_spread_v3, simple_tag_v3
from pettingzoo import ParallelEnv
from pettingzoo.utils.conversions import turn_based_aec_to_parallel

pytestmark = [
    pytest.mark.simulators,
    pytest.mark.filterwarnings("ignore:.*precision lowered:UserWarning"),
]

HERE = __name__


def entry(task: str, **fields: Any) -> EnvConfig:
    return EnvConfig(name="zoo", backend="pettingzoo", task=task, **fields)


def make(task: str, **fields: Any) -> PettingZooEnv:
    from rlightning_aio.envs.simulators.pettingzoo import PettingZooEnv

    return PettingZooEnv(entry(task, **fields))


def parallel_outcomes(env: Any, seed: int, actions: Sequence[Any]) -> Iterator[Expected]:
    """For a parallel environment whose agents stay together."""
    nothing = dict.fromkeys(env.possible_agents, 0.0)
    nobody = dict.fromkeys(env.possible_agents, False)
    observations, _ = env.reset(seed=seed)
    yield observations, nothing, nobody, nobody
    for action in actions:
        if env.agents:
            observations, rewards, terminated, truncated, _ = env.step(action)
            yield observations, dict(rewards), terminated, truncated
        else:
            yield env.reset()[0], nothing, nobody, nobody
    env.close()


class TestSimpleSpread(GroupContract):
    config = entry("mpe2.simple_spread_v3", env_kwargs={"N": 4, "continuous_actions": True})

    def simulate(self, actions: Sequence[Any]) -> Iterator[Expected]:
        env = simple_spread_v3.parallel_env(N=4, continuous_actions=True)
        return parallel_outcomes(env, self.seed, actions)


class TestAgentsWithDifferentSpaces(GroupContract):
    config = entry("mpe2.simple_tag_v3")

    def simulate(self, actions: Sequence[Any]) -> Iterator[Expected]:
        return parallel_outcomes(simple_tag_v3.parallel_env(), self.seed, actions)

    def test_spaces_are_dicts_by_agent(self) -> None:
        """Each agent has its own spaces, in the order of `agents`."""
        with self.opened() as env:
            assert env.agents == ("adversary_0", "adversary_1", "adversary_2", "agent_0")
            space = env.get_observation_space()
            assert isinstance(space, Dict)
            assert [space[agent].shape for agent in env.agents] == [(16,)] * 3 + [(14,)]


class TestRegistered(GroupContract):
    config = entry("sisl/pursuit-v5", env_kwargs={"n_pursuers": 3, "max_cycles": 25})
    num_steps = 60

    def simulate(self, actions: Sequence[Any]) -> Iterator[Expected]:
        env = pettingzoo.make("parallel", "sisl/pursuit-v5", n_pursuers=3, max_cycles=25)
        return parallel_outcomes(env, self.seed, actions)

    def test_its_own_limit_is_known(self) -> None:
        """SISL's environments have it in an inner object."""
        with self.opened() as env:
            assert env.get_metadata().max_episode_steps == 25


def test_modules_may_register_environments() -> None:
    """A module named before the colon is imported first."""
    assert "arena/tag-v3" not in pettingzoo.parallel_registry
    env = make("envs.registered_arena:arena/tag-v3")
    assert env.get_metadata().max_episode_steps == 7


@pytest.mark.parametrize(
    ("task", "message"),
    [
        ("sisl/persuit-v5", r"'zoo-0': .*'sisl/persuit-v5' is not reg.*mean 'sisl/pursuit-v5'\?"),
        ("classic/tictactoe-v3", r"'classic/tictactoe-v3' is turn-based; convert it"),
        ("atari/pong-v3", r"'zoo-0': .*pip install 'pettingzoo\[atari\]'"),
    ],
)
def test_environments_that_the_registry_cannot_make_raise(task: str, message: str) -> None:
    """An unknown name, one of another kind, and one with missing packages."""
    with pytest.raises(ConfigError, match=message):
        make(task)


def turns() -> ParallelEnv:
    return turn_based_aec_to_parallel(pettingzoo.make("aec", "classic/tictactoe-v3"))


def test_random_policies_make_legal_moves() -> None:
    """An illegal move ends a game of tic-tac-toe, and only one agent loses."""
    config = entry(f"{HERE}:turns", num_workers=2, placement="inline")
    with sync.build_env_group(config) as group:
        spaces = dict(zip(group.env_ids, group.get_action_spaces(), strict=True))
        policy = RandomPolicy(spaces.__getitem__, seed=0)
        batch, _ = group.reset(seed=0)
        with group.auto_reset(NO_LIMIT):
            for _ in range(200):
                batch, _ = group.step(batch.respond(action=policy(batch)))
                assert (batch.reward["player_1"] == -batch.reward["player_2"]).all()
        episodes = [stats["episodes"] for stats in group.get_env_stats().values()]
    # One move of each agent, and a game takes at least five moves.
    assert all(20 <= count <= 2 * 200 / 5 for count in episodes)


def comings_and_goings(**_: Any) -> ParallelEnv:
    return ComingsAndGoings()


class ComingsAndGoings(ParallelEnv):
    """`early` terminates in step 2, `quitter` is truncated in step 3, `late` joins in step 2,
    `ghost` vanishes in step 2 with no flag; all are gone after step 4.
    """

    metadata: ClassVar = {"name": "comings_and_goings"}
    possible_agents: ClassVar = ["early", "quitter", "ghost", "late"]

    def observation_space(self, agent: str) -> Any:
        if agent == "ghost":
            return Dict({"n": Discrete(3, start=5), "pair": Tuple((Box(1, 2, (2,)), Discrete(2)))})
        return Box(-9, 9, (2,), np.float32)

    def action_space(self, agent: str) -> Any:
        return Discrete(2)

    def _observations(self) -> dict[str, Any]:
        ones = np.ones(2, np.float32)
        ghost = {"n": 6, "pair": (np.full(2, 1.5, np.float32), 1)}
        return {agent: ghost if agent == "ghost" else ones for agent in self.agents}

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents = ["early", "quitter", "ghost"]
        self.count = 0
        return self._observations(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> Any:
        assert actions.keys() == set(self.agents)
        self.count += 1
        acting = list(self.agents)
        if self.count == 2:
            self.agents = [*acting, "late"]
        observations = self._observations()
        terminated = {a: a == "early" and self.count == 2 for a in acting}
        truncated = {a: a == "quitter" and self.count == 3 for a in acting}
        if self.count == 2:
            self.agents.remove("ghost")
            del observations["ghost"]
        if self.count == 4:
            terminated = dict.fromkeys(acting, True)
        self.agents = [a for a in self.agents if not terminated.get(a) and not truncated.get(a)]
        infos = {a: {"count": self.count} if a == "late" else {} for a in self.agents}
        return observations, dict.fromkeys(acting, 1.0), terminated, truncated, infos


def awkward_episode(**fields: Any) -> list[MultiAgentEnvRet]:
    env = make(f"{HERE}:comings_and_goings", **fields)
    results = [env.reset(seed=0)]
    for _ in range(4):
        results.append(env.step(PolicyResponse("zoo-0", dict.fromkeys(env.agents, 1))))
        assert env.get_observation_space().contains(results[-1].observation)
    return results


def test_every_result_has_all_agents() -> None:
    """Absent agents have their flags, no reward, and the element of their space nearest to zero;
    empty infos are left out.
    """
    results = awkward_episode()
    flags = [
        {a: (r.last_terminated[a], r.last_truncated[a]) for a in r.last_terminated} for r in results
    ]
    here, terminated, truncated = (False, False), (True, False), (False, True)
    assert [f["early"] for f in flags] == [here, here] + [terminated] * 3
    assert [f["quitter"] for f in flags] == [here] * 3 + [truncated] * 2
    assert [f["ghost"] for f in flags] == [here, here] + [terminated] * 3
    assert [f["late"] for f in flags] == [here] * 4 + [terminated]
    last = results[3]
    assert last.observation["early"].tolist() == [0.0, 0.0]
    ghost = last.observation["ghost"]
    assert ghost["n"] == 5
    assert ghost["pair"][0].tolist() == [1.0, 1.0]
    assert last.last_reward == {"early": 0.0, "quitter": 1.0, "ghost": 0.0, "late": 1.0}
    late = [{"late": {"count": 2}}, {"late": {"count": 3}}]
    assert [result.info for result in results] == [{}, {}, *late, {}]


class Relay(ParallelEnv):
    """`first` ends with step 3; `second` joins in step 2, ends with step 5; `third` never comes."""

    metadata: ClassVar = {"name": "relay"}
    possible_agents: ClassVar = ["first", "second", "third"]

    def observation_space(self, agent: str) -> Any:
        return Discrete(9)

    action_space = observation_space

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents, self.count = ["first"], 0
        return {"first": 0}, {}

    def step(self, actions: dict[str, Any]) -> Any:
        self.count += 1
        seen = [*self.agents, *(["second"] if self.count == 2 else [])]
        terminated = {agent: self.count == (3 if agent == "first" else 5) for agent in seen}
        self.agents = [agent for agent in seen if not terminated[agent]]
        flags = dict.fromkeys(seen, False)
        return dict.fromkeys(seen, self.count), dict.fromkeys(seen, 1.0), terminated, flags, {}


def relay(**_: Any) -> ParallelEnv:
    return Relay()


@pytest.mark.parametrize(("limit", "length"), [(None, 5), (4, 4)])
def test_an_episode_waits_for_agents_that_join_late(limit: int | None, length: int) -> None:
    """But not for those that don't come while others are left."""
    fields = {} if limit is None else {"max_episode_steps": limit}
    config = {"name": "r", "backend": "pettingzoo", "task": f"{HERE}:relay", **fields}
    nothing = {agent: [0] for agent in Relay.possible_agents}
    with sync.build_env_group({**config, "placement": "inline"}) as group:
        with group.auto_reset(limit or 99):
            batch, _ = group.reset()
            resets = []
            for _ in range(2 * (length + 1)):
                batch, _ = group.step(batch.respond(action=nothing))
                resets.append(bool(batch.is_reset[0]))
            assert resets == ([False] * length + [True]) * 2
        with group.auto_reset(limit or 99):
            found = evaluate(group, lambda batch: nothing, episodes=2)
    assert [episode.reward for episode in found.attempts] == [3.0 + length - 1] * 2


def test_the_step_limit_truncates_the_remaining_agents() -> None:
    """Agents that ended earlier keep their flags."""
    third = awkward_episode(max_episode_steps=3)[3]
    assert third.last_truncated == {"early": False, "quitter": True, "ghost": False, "late": True}
    assert third.last_terminated["early"]


def test_the_simulators_own_limit_is_known() -> None:
    """MPE's is called max_cycles."""
    assert make("mpe2.simple_v3").get_metadata().max_episode_steps == 25
    spread = make("mpe2.simple_v3", env_kwargs={"max_cycles": 9})
    assert spread.get_metadata().max_episode_steps == 9


def test_a_step_without_agents_raises_with_the_fix() -> None:
    """Before the first reset and after the end of an episode no agent can act."""
    env = make(f"{HERE}:comings_and_goings", max_episode_steps=None)
    env.env.agents = []
    with pytest.raises(RuntimeError, match=r"'zoo-0' has no agents: reset it"):
        env.step(PolicyResponse("zoo-0", {}))


def test_a_module_without_the_function_raises() -> None:
    """The message describes valid tasks."""
    with pytest.raises(ConfigError, match=r"mpe2 has no function parallel_env; task names"):
        make("mpe2")
