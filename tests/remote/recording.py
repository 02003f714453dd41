"""An env that writes down which requests it has executed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from kit.counting import CountingEnv

if TYPE_CHECKING:
    from pathlib import Path

    from rlightning_aio import PolicyResponse

HEARTBEAT = 0.8


class RecordingEnv(CountingEnv):
    """Its observation is (identity, the request's number, steps since the reset).

    The action's first element is the request's number, which is appended to `path`.
    """

    def __init__(self, identity: int, path: Path) -> None:
        super().__init__(identity)
        self.number = -1
        self.file = path.open("a", buffering=1)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        self.number = -1
        return super().reset(seed=seed, options=options)

    def step(self, policy_resp: PolicyResponse) -> Any:
        self.number = int(policy_resp.action[0] * 2**20)
        self.file.write(f"{self.number}\n")
        return super().step(policy_resp)

    def ret(self) -> Any:
        ret = super().ret()
        ret.observation[1] = self.number
        return ret

    def close(self) -> None:
        super().close()
        self.file.close()
