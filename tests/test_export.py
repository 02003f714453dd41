"""Episodes of rollouts, and what LeRobot reads of the dataset they are saved as."""

from __future__ import annotations

import copy
import os
import signal
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from kit.scripted import Counts

from rlightning_aio import sync
from rlightning_aio.collecting import Collector
from rlightning_aio.collecting.episodes import whole_episodes
from rlightning_aio.plugins.lerobot_dataset import LeRobotWriter, named_columns
from rlightning_aio.spaces import Anything

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from rlightning_aio import BatchedData
    from rlightning_aio.collecting import Rollout


class Counting(Counts):
    """Shows the number of its episode and of its step; the third step is the last."""

    observation_space = gym.spaces.Dict(
        agent_pos=gym.spaces.Box(0, 99, (2,), np.float64),
        pixels=gym.spaces.Box(0, 255, (64, 96, 3), np.uint8),
    )
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    length = 3

    def does(self, action: Any) -> float:
        return self.steps + 1.0

    def observed(self) -> Any:
        place = np.array([self.resets, self.steps], np.float64)
        return {"agent_pos": place, "pixels": np.full((64, 96, 3), 40 * self.steps, np.uint8)}


def halves(batch: BatchedData) -> dict[str, Any]:
    return {"action": np.full((len(batch), 1), 0.5, np.float32)}


def rollouts_of(num_steps: int, count: int, *, wait_all: bool = False) -> Iterator[Rollout]:
    entry = {"name": "env", "task": Counting, "num_workers": 2, "placement": "inline"}
    with sync.build_env_group(entry) as group, group.auto_reset(9):
        collector = Collector(group, halves, num_transitions=num_steps, wait_all=wait_all)
        for _ in range(count):
            yield collector.collect()


@pytest.mark.parametrize("wait_all", [False, True])
def test_rollouts_are_joined_to_whole_episodes(wait_all: bool) -> None:
    """Wherever they were cut: here after two steps of each env."""
    episodes = list(whole_episodes(rollouts_of(4, 6, wait_all=wait_all)))
    assert len(episodes) == 8
    for episode in episodes:
        number = episode.observation["agent_pos"][0, 0]
        expected = [[number, step] for step in range(4)]
        np.testing.assert_array_equal(episode.observation["agent_pos"], expected)
        np.testing.assert_array_equal(episode.reward, [1, 2, 3])
        np.testing.assert_array_equal(episode.terminated, [False, False, True])
        assert not episode.truncated.any()
        assert episode.action.shape == (3, 1)


class Talking(Counting):
    """Tells and is told plain Python values, as an OpenEnv session is."""

    observation_space = gym.spaces.Dict(rest=Anything(), count=gym.spaces.Discrete(9))
    action_space = Anything()

    def observed(self) -> Any:
        return {"rest": {"text": str(self.steps)}, "count": self.steps}


@pytest.mark.parametrize("wait_all", [False, True])
def test_episodes_of_plain_values_are_lists(tmp_path: Path, wait_all: bool) -> None:
    """A LeRobot dataset can't hold these, and says so."""

    def policy(batch: BatchedData) -> dict[str, Any]:
        return {"action": [{"say": one["text"]} for one in batch.observation["rest"]]}

    entry = {"name": "env", "task": Talking, "num_workers": 2, "placement": "inline"}
    with sync.build_env_group(entry) as group, group.auto_reset(9):
        collector = Collector(group, policy, num_transitions=8, wait_all=wait_all)
        rollouts = [copy.deepcopy(collector.collect()) for _ in range(3)]
    episodes = [*whole_episodes(rollouts)]
    assert len(episodes) > 4
    for episode in episodes:
        assert episode.observation["rest"] == [{"text": str(step)} for step in range(4)]
        assert episode.observation["count"].tolist() == [0, 1, 2, 3]
        assert episode.action == [{"say": str(step)} for step in range(3)]
    writer = LeRobotWriter("talking/none", tmp_path / "none", fps=10)
    with pytest.raises(ValueError, match="hold plain Python values"), writer:
        writer.add(rollouts[0])


class Dying(Counting):
    """The worker that executes its second step for the first time dies."""

    def __init__(self, marker: Path) -> None:
        super().__init__()
        self._marker = marker

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self.steps == 1 and not self._marker.exists():
            self._marker.touch()
            os._exit(1)
        return super().step(action)


def test_an_episode_that_was_lost_is_left_out(tmp_path: Path) -> None:
    """With its worker, which was replaced by one that begins anew."""
    entry: dict[str, Any] = {"name": "env", "task": lambda: Dying(tmp_path / "marker")}
    with sync.build_env_group(entry) as group, group.auto_reset(9):
        rollout = Collector(group, halves, num_transitions=9, wait_all=True).collect()
    episodes = list(whole_episodes([rollout]))
    for episode in episodes:
        np.testing.assert_array_equal(episode.observation["agent_pos"][:, 1], range(4))
    assert len(episodes) == 2


def test_an_episode_with_its_begin_in_a_rollout_that_was_not_added_is_left_out() -> None:
    with sync.build_env_group({"name": "env", "task": Counting}) as group, group.auto_reset(9):
        collector = Collector(group, halves, num_transitions=2, wait_all=True)
        collector.collect()
        rollouts = (collector.collect() for _ in range(2))
        (episode,) = whole_episodes(rollouts)
        assert episode.observation["agent_pos"][0].tolist() == [2.0, 0.0]


@pytest.fixture(scope="module")
def datasets() -> Any:
    """LeRobot's module, with what it keeps for as long as the process lives."""
    module = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    pytest.importorskip("tqdm").tqdm.get_lock()
    return module


@pytest.mark.simulators
def test_lerobot_reads_the_episodes(datasets: Any, tmp_path: Path) -> None:
    """With their numbers as they were played, and pictures as its codec keeps them."""
    rollouts = list(rollouts_of(12, 1))
    with LeRobotWriter("counting/half", tmp_path / "half", fps=10, task="count") as writer:
        for rollout in rollouts:
            writer.add(rollout)
    dataset = datasets.LeRobotDataset("counting/half", root=tmp_path / "half")
    episodes = list(whole_episodes(rollouts))
    assert (dataset.num_episodes, len(dataset)) == (4, 12)
    for position, frame in enumerate(dataset):
        episode, step = divmod(position, 3)
        played_by = episodes[episode]
        seen = played_by.observation["agent_pos"][step]
        np.testing.assert_array_equal(frame["observation.state"].numpy(), seen.astype(np.float32))
        assert frame["observation.image"].shape == (3, 64, 96)
        assert abs(float(frame["observation.image"].mean()) * 255 - 40 * step) < 8
        assert float(frame["next.reward"]) == step + 1
        assert bool(frame["next.done"]) == (step == 2)
        assert frame["task"] == "count"


@pytest.mark.simulators
def test_episodes_before_a_fault_are_saved_and_others_appended(
    datasets: Any, tmp_path: Path
) -> None:
    """A rollout may end in the midst of one; what was begun when the fault came is left out."""
    fields: dict[str, Any] = {"root": tmp_path / "half", "fps": 10, "task": "count"}

    def collected(count: int) -> list[int]:
        with LeRobotWriter("counting/half", **fields) as writer:
            for rollout in rollouts_of(4, count):
                writer.add(rollout)
            raise KeyboardInterrupt

    for count in (5, 2):  # Of 20 and of 8 transitions: six whole episodes, and two.
        with pytest.raises(KeyboardInterrupt):
            collected(count)
    dataset = datasets.LeRobotDataset("counting/half", root=tmp_path / "half")
    assert (dataset.num_episodes, len(dataset)) == (8, 24)
    steps = [frame["observation.state"][1].item() for frame in dataset]
    assert steps == [0, 1, 2] * 8
    other = LeRobotWriter("counting/half", **{**fields, "fps": 5})
    with pytest.raises(ValueError, match="fps: 10, not 5"), other as writer:
        writer.add(next(rollouts_of(12, 1)))
    named = LeRobotWriter("counting/half", **fields, names={"agent_pos": "observation.joints"})
    with (
        pytest.warns(UserWarning, match=r"no observation\.state"),
        pytest.raises(ValueError, match=r"observation.joints: None, not float32 \(2,\)"),
        named as writer,
    ):
        writer.add(next(rollouts_of(12, 1)))


@pytest.mark.simulators
def test_ctrl_c_while_an_episode_is_written_comes_after_it(
    datasets: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half an episode would make the dataset unreadable."""
    save = datasets.LeRobotDataset.save_episode

    def interrupted(dataset: Any, **more: Any) -> None:
        signal.raise_signal(signal.SIGINT)
        save(dataset, **more)

    monkeypatch.setattr(datasets.LeRobotDataset, "save_episode", interrupted)
    writer = LeRobotWriter("counting/half", tmp_path / "half", fps=10)
    with pytest.raises(KeyboardInterrupt), writer:
        writer.add(next(rollouts_of(12, 1)))
    dataset = datasets.LeRobotDataset("counting/half", root=tmp_path / "half")
    assert (dataset.num_episodes, len(dataset)) == (1, 3)
    assert [frame["observation.state"][1].item() for frame in dataset] == [0, 1, 2]


def test_a_dataset_without_an_episode_is_refused(tmp_path: Path) -> None:
    writer = LeRobotWriter("counting/none", tmp_path / "none", fps=10)
    with pytest.raises(ValueError, match="no whole episode"), writer:
        writer.add(next(rollouts_of(4, 1)))
    assert not (tmp_path / "none").exists()


def test_columns_have_the_names_that_lerobots_policies_expect() -> None:
    image, vector = np.zeros((2, 4, 6, 3), np.uint8), np.zeros((2, 7))
    assert list(named_columns(vector, {})) == ["observation.state"]
    observation = {
        "agent_pos": vector, "environment_state": vector, "pixels": {"top": image},
        "wrist": image, "arm": {"force": vector}, "pair": (vector,),
    }  # fmt: skip
    assert list(named_columns(observation, {})) == [
        "observation.state", "observation.environment_state", "observation.images.top",
        "observation.images.wrist", "observation.arm.force", "observation.pair.0",
    ]  # fmt: skip
    assert list(named_columns({"pixels": image}, {})) == ["observation.image"]
    names = {"arm.force": "observation.state", "eye": "observation.images.eye"}
    found = named_columns({"arm": {"force": vector}, "eye": image}, names)
    assert list(found) == [*names.values()]
    with pytest.raises(ValueError, match=r"names has \['leg'\]; the observation has \['arm'\]"):
        named_columns({"arm": vector}, {"leg": "observation.state"})
    with pytest.raises(ValueError, match=r"two columns .* observation\.state"):
        named_columns({"agent_pos": vector, "arm": vector}, {"arm": "observation.state"})
