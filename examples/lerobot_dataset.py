"""Write the episodes of a `Collector` as a LeRobot dataset."""

import tempfile
from pathlib import Path

from lerobot.datasets.lerobot_dataset import LeRobotDataset

from rlightning_aio import sync
from rlightning_aio.collecting import Collector
from rlightning_aio.plugins.lerobot_dataset import LeRobotWriter

entry = {
    "name": "pusht",
    "backend": "gymnasium",
    "task": "gym_pusht:gym_pusht/PushT-v0",
    "num_workers": 2,
    "max_episode_steps": 10,
}
root = Path(tempfile.mkdtemp(), "pushed")
with sync.build_env_group(entry) as group:
    collector = Collector(group, None, num_transitions=25)  # None: random actions.
    with LeRobotWriter("me/pushed", root, fps=10, task="push the block onto the goal") as writer:
        for _ in range(3):
            writer.add(collector.collect())
print(len(LeRobotDataset("me/pushed", root=root)))
