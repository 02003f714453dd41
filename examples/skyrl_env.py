"""An env of SkyRL with a process, time limits and a replacement: a group of one."""

from skyrl_gym.envs.base_text_env import BaseTextEnv, BaseTextEnvStepOutput

from rlightning_aio import EnvError, sync


class Shell:
    async def reset(self, **_):
        self.commands = 0
        return "$", {}

    async def step(self, command):
        self.commands += 1
        return f"{command}: done", float(command == "ls"), self.commands == 2, False, {}


class ShellEnv(BaseTextEnv):
    def __init__(self, *_, **__):  # SkyRL gives it a config and extras.
        super().__init__()
        self.group = sync.build_env_group(Shell, name="sh", num_workers=1, step_timeout=60)
        self.group.init()

    def init(self, prompt):
        said = self.group["sh-0"].reset().observation
        return [*prompt, {"role": "user", "content": said}], {}

    def step(self, action):
        result = self.group["sh-0"].step(action)
        if (lost := result.info.get("outcome")) is not None:
            raise EnvError(lost.cause, blame=lost.blame)
        said, done = result.observation, result.last_terminated or result.last_truncated
        return BaseTextEnvStepOutput(
            observations=[{"role": "user", "content": said}],
            reward=result.last_reward,
            done=bool(done),
            metadata={},
        )

    def close(self):
        self.group.close()


if __name__ == "__main__":
    env = ShellEnv()
    env.init([{"role": "user", "content": "List the files."}])
    print(env.step("ls"), env.step("cat"))
    env.close()
