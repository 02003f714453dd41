"""A group as a vector environment of Tianshou, and its `Collector` over that."""

import numpy as np
from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import BaseVectorEnv
from tianshou.utils.net.common import Net

from rlightning_aio import BatchedData, PolicyResponse
from rlightning_aio.sync import build_env_group


class GroupVectorEnv(BaseVectorEnv):
    """Steps the envs of a group."""

    is_async = is_closed = False

    def __init__(self, group):
        self.group, self.env_num = group, len(group)

    def get_env_attr(self, key, id=None):  # noqa: A002 - Tianshou's name
        return [self.group[self.group.env_ids[k]].get_attr(key) for k in self._wrap_id(id)]

    def reset(self, env_id=None, **kwargs):
        env_ids = [self.group.env_ids[k] for k in self._wrap_id(env_id)]
        batch, _ = self.group.reset(env_ids=env_ids, **kwargs)
        return batch.observation, np.array(batch.info())

    def step(self, action, id=None):  # noqa: A002 - Tianshou's name
        requests = {
            self.group.env_ids[k]: a for k, a in zip(self._wrap_id(id), action, strict=True)
        }
        responses = [PolicyResponse(env_id, action=a) for env_id, a in requests.items()]
        batch, _ = self.group.step(BatchedData(list(requests), responses))
        pairs = zip(batch.info(), batch.index, strict=True)
        infos = np.array([{**info, "env_id": k} for info, k in pairs])
        return batch.observation, batch.reward, batch.terminated, batch.truncated, infos

    def close(self):
        self.group.close()


group = build_env_group("CartPole-v1", num_workers=4)
group.init()
envs = GroupVectorEnv(group)
observations, actions = group.get_observation_spaces()[0], group.get_action_spaces()[0]
policy = DiscreteQLearningPolicy(
    model=Net(state_shape=observations.shape, action_shape=actions.n, hidden_sizes=[16]),
    observation_space=observations,
    action_space=actions,
)
collector = Collector(policy, envs, VectorReplayBuffer(2000, len(envs)))
statistics = collector.collect(n_step=400, reset_before_collect=True)
print(statistics.n_collected_steps, "steps,", statistics.n_collected_episodes, "episodes")
envs.close()
