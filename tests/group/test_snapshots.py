"""Snapshots that are kept, and those that are refused; that a restored env continues exactly as the
original would have, random programs show, and tests/envs/test_state.py for each simulator.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import pytest
from kit.scripted import Saved
from run_python import output_of

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio.errors import EnvBusy, EnvRaised, SnapshotError

if TYPE_CHECKING:
    from pathlib import Path

    from rlightning_aio.batch import BatchedData


ENTRIES: dict[str, dict[str, Any]] = {
    "gymnasium": {"backend": "gymnasium", "task": "CartPole-v1"},
    "mujoco": {"backend": "mujoco", "task": "Hopper-v5"},
}


def entry_of(kind: str, **fields: Any) -> dict[str, Any]:
    return {"name": "e", "num_workers": 2, **ENTRIES[kind], **fields}


def stepped(group: sync.EnvGroup, batch: BatchedData, num_steps: int, seed: int) -> BatchedData:
    """Step with random actions; return the last results."""
    space: Any = group.get_action_spaces()[0]
    space.seed(seed)
    for _ in range(num_steps):
        batch, _ = group.step(batch.respond(action=[space.sample() for _ in batch.ids()]))
    return batch


def test_a_snapshot_can_be_restored_in_another_run(tmp_path: Path) -> None:
    """A snapshot is a plain file; the env that it is restored into was never reset."""
    config = entry_of("mujoco")
    with sync.build_env_group(config) as group:
        batch, _ = group.reset(seed=1)
        batch = stepped(group, batch, 7, 0)
        (tmp_path / "snapshot").write_bytes(group.snapshot())
        batch = stepped(group, batch, 5, 1)
    program = tmp_path / "program.py"
    program.write_text(
        "from rlightning_aio import sync\n"
        f"with sync.build_env_group({config!r}) as group:\n"
        "    batch, _ = group.restore(open('snapshot', 'rb').read())\n"
        "    space = group.get_action_spaces()[0]\n"
        "    space.seed(1)\n"
        "    for _ in range(5):\n"
        "        actions = [space.sample() for _ in range(2)]\n"
        "        batch, _ = group.step(batch.respond(action=actions))\n"
        "    print(batch.observation.tobytes().hex())\n"
    )
    assert output_of(program, folder=tmp_path).strip() == batch.observation.tobytes().hex()


# -- misuse


def spoilt(snapshot: bytes) -> list[bytes]:
    middle = len(snapshot) // 2
    flipped = snapshot[:middle] + bytes([snapshot[middle] ^ 1]) + snapshot[middle + 1 :]
    return [b"", snapshot[:-1], snapshot[:10], flipped, snapshot + b"0", b"x" + snapshot]


def test_a_spoilt_snapshot_is_refused() -> None:
    """Before its content is read."""
    with sync.build_env_group(entry_of("gymnasium", placement="inline")) as group:
        group.reset(seed=0)
        for data in spoilt(group.snapshot()):
            with pytest.raises(SnapshotError, match="nothing was changed"):
                group.restore(data)
        with pytest.raises(SnapshotError, match="not a str"):
            group.restore("a file's name")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"task": "Acrobot-v1"}, "its task is CartPole-v1, and here it is Acrobot-v1"),
        ({"max_episode_steps": 7}, "its max_episode_steps is None, and here it is 7"),
        ({"env_kwargs": {"sutton_barto_reward": True}}, "env_kwargs"),
        ({"num_envs": 2}, "num_envs is 1, and here it is 2"),
    ],
)
def test_a_snapshot_of_something_else_is_refused(changed: dict[str, Any], message: str) -> None:
    """The message says what differs; the envs continue unchanged."""
    with (
        sync.build_env_group(entry_of("gymnasium", placement="inline")) as one,
        sync.build_env_group(entry_of("gymnasium", placement="inline", **changed)) as other,
    ):
        one.reset(seed=0)
        other.reset(seed=0)
        with pytest.raises(SnapshotError, match=message):
            other.restore(one.snapshot())


def test_another_version_of_the_simulator_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """It might compute something else."""
    with sync.build_env_group(entry_of("mujoco", placement="inline")) as group:
        group.reset(seed=0)
        snapshot = group.snapshot()
        monkeypatch.setattr("mujoco.__version__", "2.0")
        with pytest.raises(EnvRaised, match=r"with version .* of mujoco, and here it is 2\.0"):
            group.restore(snapshot)


class Fragile(Saved):
    """Restoring the second env fails once."""

    action_space = gym.spaces.Discrete(3)
    fails: Any = None

    def does(self, action: Any) -> None:
        if action:
            self.fails = "raise" if action == 1 else "exit"

    def load_state(self, state: int) -> None:
        super().load_state(state)
        if state == 1 and self.fails == "raise":
            raise OSError("the disk is gone")


def test_an_env_that_cannot_be_restored_is_lost_and_the_others_are_restored() -> None:
    """The error names it and has their results; its next request is a reset."""
    entry = {"name": "e", "task": Fragile, "num_workers": 3, "placement": "inline"}
    with sync.build_env_group(entry) as group:
        batch, _ = group.reset()
        batch, _ = group.step(batch.respond(action=[0, 0, 0]))
        snapshot = group.snapshot()
        for _ in range(3):
            batch, _ = group.step(batch.respond(action=[0, 1, 0]))
        with pytest.raises(EnvRaised, match=r"env 'e-1'.*restore.*the disk is gone") as caught:
            group.restore(snapshot)
        shown = caught.value.results
        assert shown is not None
        assert (shown.ids(), shown.observation.tolist()) == (["e-0", "e-2"], [[1], [1]])
        with pytest.raises(SnapshotError, match=r"'e-1' has lost its.*could not be restored"):
            group.snapshot()
        batch, _ = group.step(batch.respond(action=[0, 0, 0]))
        assert batch.observation.tolist() == [[2], [0], [2]]
        assert batch.restarted.tolist() == [False, True, False]
        (info,) = batch.take([1]).info()
        assert info["worker_restarted"] == "could not be restored"
        assert (info["outcome"].kind, info["outcome"].blame) == ("not_started", "env")
        group.snapshot()


class Unloadable:
    """Awaitable; each step ends its episode, and it shows the seed."""

    seed: Any = None

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.seed = seed
        return seed, {}

    async def step(self, action: Any) -> Any:
        return self.seed, 0.0, True, False, {}

    def load_state(self, state: Any) -> None:
        raise OSError("the disk is gone")

    def save_state(self) -> Any:
        return None


async def test_an_episode_that_had_ended_is_not_begun_again_after_a_failed_restore() -> None:
    """Nor with its options, which may hold code."""
    async with rl.build_env_group(Unloadable, placement="loop") as group, group.auto_reset(9):
        batch, _ = await group.reset(seed=3, options={"judge": lambda: 0})
        snapshot = await group.snapshot()
        await group.step(batch.respond(action=[0]))
        with pytest.raises(EnvRaised, match="the disk is gone"):
            await group.restore(snapshot)
        batch, _ = await group.step(batch.respond(action=[0]))
    assert (batch.restarted.tolist(), batch.observation) == ([True], [None])


def test_a_snapshot_without_the_state_to_branch_is_refused() -> None:
    with sync.build_env_group(entry_of("gymnasium", num_workers=3, placement="inline")) as group:
        group.reset(seed=3)
        snapshot = group.snapshot(["e-2", "e-0"])
        with pytest.raises(SnapshotError, match="no state of 'e-1', only of e-2, e-0; nothing"):
            group.restore(snapshot, source="e-1")


class Hidden(Fragile):
    """Holds an object that can't be pickled."""

    save_state = load_state = property()  # type: ignore[assignment]  # As if it had none.

    def __init__(self) -> None:
        self.handle = threading.Lock()


def test_an_env_that_cannot_be_saved_names_the_attribute() -> None:
    """The attribute that can't be pickled."""
    with sync.build_env_group({"name": "e", "task": Hidden, "placement": "inline"}) as group:
        group.reset()
        with pytest.raises(EnvRaised, match=r"env\.env\.handle of env 'e-0', a lock"):
            group.snapshot()


def test_envs_that_a_snapshot_does_not_fit_are_refused() -> None:
    """As many envs as the snapshot has, each once, idle, known, and named if they are others."""
    fields = entry_of("gymnasium", placement="inline")
    with (
        sync.build_env_group(fields) as two,
        sync.build_env_group({**fields, "num_workers": 3}) as three,
        sync.build_env_group({**fields, "name": "f"}) as others,
    ):
        with pytest.raises(SnapshotError, match="env 'e-0' has no state yet: reset it"):
            two.snapshot()
        for group in (three, others):
            group.reset(seed=0)
        batch, _ = two.reset(seed=0)
        snapshot = two.snapshot()
        for group, env_ids, error, said in (
            (two, ["e-0"], SnapshotError, "is of 2 envs, but should go into 1"),
            (two, ["e-0", "e-0"], EnvBusy, "twice"),
            (two, ["e-0", "f-0"], rl.UnknownEnv, "'f-0'"),
            (three, None, SnapshotError, "of 2 envs, but should go into 3; name"),
            (others, None, SnapshotError, "of 'e-0', and this group has no such env; name"),
        ):
            with pytest.raises(error, match=said):
                group.restore(snapshot, env_ids=env_ids)
        for group, env_ids in ((three, ["e-2", "e-0"]), (others, ["f-0", "f-1"])):
            shown, _ = group.restore(snapshot, env_ids=env_ids)
            assert shown.ids() == env_ids
        two.step_async(batch.respond(action=[0, 0]))
        for call in (two.snapshot, lambda: two.restore(snapshot)):
            with pytest.raises(EnvBusy):
                call()
        two.collect_async(wait_all=True)
