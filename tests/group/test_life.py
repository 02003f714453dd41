"""Start and close of groups, sources of env classes, and the surroundings of a group."""

from __future__ import annotations

import asyncio
import gc
import re
import sys
import threading
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import uvloop
from group import sample_envs
from run_python import output_of

import rlightning_aio
from rlightning_aio import BatchedData, GroupClosed, PolicyResponse, StartFailed, sync
from rlightning_aio._core.hosts.process import spares

PROBE = {"name": "probe", "backend": "probe", "task": "x", "num_workers": 3}


def children() -> set[str]:
    """Return the pids of child processes, without fork servers that are kept for other groups."""
    found: set[str] = set()
    for path in Path("/proc/self/task").glob("*/children"):
        found |= set(path.read_text().split())
    return found - {str(spare.process.pid) for spare in spares.kept()}


# -- start and close


def test_building_a_group_starts_nothing() -> None:
    """`init` starts the processes; a group that is dropped before leaves nothing behind."""
    before = children()
    group = sync.build_env_group(PROBE)
    assert (len(group), group.size(), group.env_ids[2]) == (3, 3, "probe-2")
    assert children() == before
    group.init()
    assert children() > before
    group.close()
    assert children() == before
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        del group
        sync.build_env_group(PROBE)


async def test_a_context_initialises_and_closes(place: Any) -> None:
    """Also if its body raises."""
    group = place.build(PROBE)

    async def use() -> None:
        async with group as entered:
            assert entered is group
            assert (await group.reset())[0].ids() == group.env_ids
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        await use()
    with pytest.raises(GroupClosed):
        await group.reset()


@pytest.mark.one_driver_for_each_place
async def test_an_env_that_cannot_be_built_fails_the_start(place: Any) -> None:
    """With its error; all other envs are closed, and so is the group."""
    group = place.build([PROBE, {**PROBE, "name": "bad", "env_kwargs": {"fails": 1}}])
    before = children()
    with pytest.raises(StartFailed, match=r"'bad-1'.*RuntimeError: no simulator here") as caught:
        await group.init()
    assert caught.value.env_id == "bad-1"
    assert "raise RuntimeError" in str(caught.value.__cause__)
    assert children() == before
    with pytest.raises(GroupClosed):
        await group.init()
    await group.close()


@pytest.mark.one_driver_for_each_place
@pytest.mark.parametrize("moment", ["before init", "after close"])
async def test_a_group_that_is_not_open_refuses_all_operations(place: Any, moment: str) -> None:
    """The error says what to do; close can be called any number of times."""
    group = place.build(PROBE)
    if moment == "after close":
        await group.init()
        batch, _ = await group.reset()
        group.step_async(batch.respond(action=np.zeros((3, 2))))
        await group.close()
    before = moment == "before init"
    error, said = GroupClosed, "init" if before else "build a new one"
    step = BatchedData(["probe-0"], [PolicyResponse("probe-0", [0, 0])])
    for request in (
        group.reset,
        lambda: group.step(step),
        group.collect_async,
        group.drain,
        group.abort,
        group.snapshot,
        lambda: group.restore(b""),
        group.offload,
        lambda: group["probe-0"].call("double", 1),
        lambda: group["probe-0"].get_attr("label"),
    ):
        with pytest.raises(error, match=said):
            await request()
    for plain in (
        lambda: group.step_async(step),
        group.reset_async,
        lambda: group.pending,
        lambda: group.metas,
        group.get_observation_spaces,
        group.get_action_spaces,
    ):
        with pytest.raises(error, match=said) as caught:
            plain()
        assert type(caught.value) is error
    await group.close()
    await group.close()
    with pytest.raises(GroupClosed, match="build a new one"):
        await group.init()


def test_a_group_that_cannot_be_built_holds_nothing() -> None:
    """What its first entry had allocated is released when the second one fails."""
    held = len(list(Path("/proc/self/fd").iterdir()))
    wrong = {**PROBE, "name": "other", "env_kwargs": {"lock": threading.Lock()}}
    for build in (sync.build_env_group, rlightning_aio.build_env_group):
        with pytest.raises(TypeError, match="lock"):
            build([PROBE, wrong])
    gc.collect()
    assert len(list(Path("/proc/self/fd").iterdir())) == held


# -- surroundings


def use(group: Any) -> list[float]:
    batch, _ = group.reset(seed=1)
    group.step_async(batch.respond(action=np.array([[0, 4.0]] * 3)))
    batch, _ = group.collect_async(wait_all=True)
    return batch.reward.tolist()


def test_a_group_may_outlive_the_thread_that_started_it() -> None:
    """Workers belong to the process; one thread at a time may use the group."""
    group = sync.build_env_group(PROBE)
    found: list[list[float]] = []
    starter = threading.Thread(target=lambda: (group.init(), found.append(use(group))))
    starter.start()
    starter.join()
    found.append(use(group))
    user = threading.Thread(target=lambda: (found.append(use(group)), group.close()))
    user.start()
    user.join()
    assert found == [[4.0] * 3] * 3


def test_an_async_group_runs_in_a_loop_of_any_thread() -> None:
    """Also in a loop that is not in the main thread."""
    found: list[float] = []

    async def main() -> None:
        async with rlightning_aio.build_env_group(PROBE) as group:
            batch, _ = await group.reset()
            batch, _ = await group.step(batch.respond(action=np.array([[0, 2.0]] * 3)))
            found.extend(batch.reward.tolist())

    thread = threading.Thread(target=lambda: asyncio.run(main()))
    thread.start()
    thread.join()
    assert found == [2.0] * 3


def test_run_picks_the_faster_loop() -> None:
    """It returns the coroutine's result."""

    async def main() -> str:
        return type(asyncio.get_running_loop()).__module__

    assert rlightning_aio.run(main()) == uvloop.__name__


async def test_run_says_what_to_do_where_a_loop_runs() -> None:
    """For example in a notebook."""
    with pytest.raises(RuntimeError, match="`await` the coroutine instead"):
        rlightning_aio.run(asyncio.sleep(0))


async def test_groups_of_both_kinds_side_by_side() -> None:
    """Two asynchronous groups and a synchronous one in one loop, each with its own workers."""
    async with (
        rlightning_aio.build_env_group(PROBE) as one,
        rlightning_aio.build_env_group({**PROBE, "name": "other"}) as other,
    ):
        threads = threading.active_count()
        with sync.build_env_group({**PROBE, "name": "third"}) as third:
            assert threading.active_count() == threads, "a synchronous group needs no loop"
            batches = await asyncio.gather(one.reset(seed=1), other.reset(seed=2))
            assert [batch.observation[0, 3] for batch, _ in batches] == [1, 2]
            assert use(third) == [4.0] * 3
            crossed = batches[0][0].respond(action=np.zeros((3, 2)))
            with pytest.raises(rlightning_aio.UnknownEnv, match="'probe-0'"):
                await other.step(crossed)


# -- sources of env classes

MODULE = """
import numpy as np
from gymnasium import spaces
from rlightning_aio import ENVS, BaseEnv, EnvRet

class Counter(BaseEnv):
    observation_space = spaces.Discrete(1000)

    def get_observation_space(self): return spaces.Discrete(1000)
    def get_action_space(self): return spaces.Discrete(1000)
    def reset(self, *, seed=None, options=None):
        self.total = seed or 0
        return EnvRet(env_id=self.env_id, observation=self.total)
    def step(self, policy_resp):
        self.total += self._preprocess_fn(policy_resp)
        return EnvRet(env_id=self.env_id, observation=self.total, last_reward=1.0)
"""

SCRIPT = (
    MODULE
    + """
from dataclasses import dataclass
from rlightning_aio import BatchedData, PolicyResponse, sync

ENVS.register("counter")(Counter)

@dataclass
class Thought:
    weight: int

def weigh(response):
    return int(response.action) * getattr(response, "thought", Thought(1)).weight

class Totals(spaces.Space):
    def contains(self, x):
        return isinstance(x, int)

class Spoken(Counter):
    def get_observation_space(self): return spaces.Dict(total=Totals())
    def reset(self, **given):
        ret = super().reset(**given)
        return EnvRet(env_id=self.env_id, observation={"total": ret.observation})
    def step(self, policy_resp):
        ret = super().step(policy_resp)
        return EnvRet(env_id=self.env_id, observation={"total": ret.observation})

if __name__ == "__main__":
    for placement in ("process", "inline"):
        entry = {"name": "c", "backend": "counter", "task": "x", "num_workers": 2,
                 "placement": placement}
        with sync.build_env_group(entry, preprocess_fn=weigh) as group:
            batch, _ = group.reset(seed=5)
            batch, _ = group.step(batch.respond(action=np.array([1, 2])))
            response = PolicyResponse("c-1", 3, thought=Thought(10))
            batch, _ = group.step(BatchedData(["c-1"], [response]))
            print(placement, batch.observation.tolist(), group["c-0"].step(1).observation)
    ENVS.register("spoken")(Spoken)
    with sync.build_env_group({"name": "s", "backend": "spoken", "task": "x"}) as group:
        batch, _ = group.reset(seed=3)
        batch, _ = group.step(batch.respond(action=np.array([4])))
        print([int(total) for total in batch.observation["total"]])
"""
)


def test_a_script_may_define_its_own_envs(tmp_path: Path) -> None:
    """With their classes, functions and spaces in `__main__`, for both placements."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    assert output_of(script).splitlines() == ["process [38] 7", "inline [38] 7", "[7]"]


@pytest.mark.one_driver_for_each_place
async def test_a_module_that_only_workers_import_may_define_them(
    place: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is named in `imports`, and registers its backend where the env is built."""
    module = f"own_envs_{place.name.replace(' ', '_')}_{place.synchronous}"
    path = tmp_path / f"{module}.py"
    source = MODULE + f"\nENVS.register({module!r})(Counter)\n"
    on_loop = place.name == "loop"
    path.write_text(re.sub("def (reset|step)", r"async def \1", source) if on_loop else source)
    monkeypatch.syspath_prepend(tmp_path)
    entry = {"name": "c", "backend": module, "task": "x", "imports": [module]}
    async with place.build(entry) as group:
        batch, _ = await group.reset(seed=3)
        batch, _ = await group.step(batch.respond(action=np.array([4])))
        assert batch.observation.tolist() == [7]
    assert (module in sys.modules) == (place.inline or on_loop)


def test_workers_collect_garbage() -> None:
    """The fork server disables it only while it imports."""

    class Asked(sample_envs.Probe):
        def collects_garbage(self) -> bool:
            return gc.isenabled()

    rlightning_aio.ENVS.register("asked")(Asked)
    with sync.build_env_group({"name": "a", "backend": "asked", "task": "x"}) as group:
        assert group["a-0"].call("collects_garbage")
