"""Both ends of an env_server: a trainer, and a client that serves an arm for three steps."""

import threading

import gymnasium as gym
import numpy as np

import rlightning_aio as rl
from rlightning_aio import ClientRefused, EnvAway, sync
from rlightning_aio.remote import RemoteEnvClient


class Arm(rl.BaseEnv):
    """Ends its service after three steps."""

    steps = 0

    def get_observation_space(self):
        return gym.spaces.Box(-1.0, 1.0, (2,))

    get_action_space = get_observation_space

    def reset(self, **_):
        return rl.EnvRet(env_id=self.env_id, observation=np.zeros(2, np.float32))

    def step(self, policy_resp):
        self.steps += 1
        return rl.EnvRet(env_id=self.env_id, observation=self._preprocess_fn(policy_resp))

    def is_finish(self):
        return self.steps >= 3


def serve(address):
    """What another machine's program does."""
    arm = Arm(rl.EnvConfig(name="arm", backend="arm", task="-"))
    with RemoteEnvClient(arm, address, name="arm") as client:
        try:
            client.run()
        except ClientRefused as error:
            print(error)


server = {"name": "robots", "backend": "env_server", "env_kwargs": {"connect_timeout": 2}}
with sync.build_env_group(**server) as group:
    arm = threading.Thread(target=serve, args=[group["robots-0"].address])
    arm.start()
    batch, _ = group.reset()
    print(batch.ids(), batch.infos["client"])  # ['robots-0/0'] ['arm']
    try:
        while True:
            batch, _ = group.step(batch.respond(action=np.ones((1, 2), np.float32)))
    except EnvAway as error:
        print(error)  # The arm has left.
    arm.join()
