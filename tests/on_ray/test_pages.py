"""What docs/performance.md says of programs, as a reader would run them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from run_python import output_of

pytestmark = pytest.mark.ray

PAGE = (Path(__file__).parents[2] / "docs" / "performance.md").read_text()


def test_programs_run_on_the_cluster_that_the_environment_names(
    nodes: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And nothing of theirs is there when they have ended."""
    monkeypatch.setenv("RAY_ADDRESS", nodes.address)
    section = PAGE.partition("\n## Beyond one machine\n")[2]
    programs = re.findall(r"^```python\n(.*?)^```", section, re.MULTILINE | re.DOTALL)
    (tmp_path / "page.py").write_text("\n".join(programs))
    output_of(tmp_path / "page.py", folder=tmp_path, asyncio_debug=False)


def test_a_cluster_that_is_not_there_is_started_and_ends_with_the_group(tmp_path: Path) -> None:
    """With a word about it where nobody has asked for it; another group may start another."""
    (tmp_path / "own.py").write_text(OWN_CLUSTER)
    said = output_of(tmp_path / "own.py", folder=tmp_path, asyncio_debug=False)
    assert said.splitlines()[-1] == "[True, False, True, False]"


OWN_CLUSTER = """
import ray
from rlightning_aio.sync import build_env_group

entry = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "placement": "ray"}
connected = []
for _ in range(2):
    with build_env_group(entry | {"ray_options": {"address": "local"}}) as group:
        group.reset()
        connected.append(ray.is_initialized())
    connected.append(ray.is_initialized())
print(connected)
"""


def test_a_group_may_live_in_an_actor() -> None:
    """A collector of its own, whose envs are worker processes of its node and actors."""
    import ray

    @ray.remote(num_cpus=0)
    def collect() -> list[float]:
        from rlightning_aio.sync import build_env_group

        entry = {"backend": "gymnasium", "task": "CartPole-v1"}
        places = [
            entry | {"name": "here"},
            entry | {"name": "there", "placement": "ray", "num_cpus": 0},
        ]
        with build_env_group(places) as group:
            batch, _ = group.reset(seed={"here-0": 1, "there-0": 1})
            batch, _ = group.step(batch.respond(action=[1, 1]))
            return batch.observation.tolist()

    here, there = ray.get(collect.remote())
    assert here == there
