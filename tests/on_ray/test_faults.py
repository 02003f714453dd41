"""An actor that dies, hangs or loses its node is a worker that does."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import pytest
import ray_cluster
from kit.driven import Driven
from kit.processes import kill, pid_of
from kit.tokens import Tokens, marked, two_workers
from patience import HANG

from rlightning_aio.errors import EnvRaised, WorkerDied

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    Start = Callable[..., Driven]

pytestmark = pytest.mark.ray

LIMIT = 1.0
"""Seconds; long enough for whoever doesn't hang, on a machine that is busy."""


@pytest.fixture
def start() -> Iterator[Start]:
    """Groups of faulty envs, two in each of two actors, initialised and reset."""
    built: list[Driven] = []

    def start(**fields: Any) -> Driven:
        built.append(
            Driven(
                "sync",
                two_workers(placement="ray", num_cpus=0, imports=["kit.faulty"], **fields),
            )
        )
        built[-1].init()
        built[-1].reset(seed=0)
        return built[-1]

    yield start
    while built:
        built.pop().end()


def test_a_death_in_a_step_gives_marked_results(start: Start) -> None:
    """One for each env of the actor, whose results are lost; the other actor just steps."""
    group, tokens = start(), Tokens()
    for death in ("sigkill", "exit 3"):
        batch, _ = group.step(tokens.steps(group.group.env_ids, {"faulty-1": death}))
        assert [marked(ret) for ret in batch.values()] == [True, True, False, False]
        assert batch.restarted.tolist() == [True, True, False, False]
        assert "worker process has died" in batch.values()[1].info["worker_restarted"]
        batch, _ = group.step(tokens.steps(group.group.env_ids))
        tokens.check(batch)


def test_an_idle_actor_that_dies_is_replaced_when_it_is_needed(start: Start) -> None:
    """Who asks next is told, and a call ends in an error."""
    group, tokens = start(), Tokens()
    kill(pid_of(group, "faulty-0"))
    batch, _ = group.step(tokens.steps(group.group.env_ids))
    assert [marked(ret) for ret in batch.values()] == [True, True, False, False]
    kill(pid_of(group, "faulty-2"))
    with pytest.raises(WorkerDied, match="env 'faulty-2'"):
        pid_of(group, "faulty-2")
    batch, _ = group.step(tokens.steps(group.group.env_ids))
    assert [marked(ret) for ret in batch.values()] == [False, False, True, True]


def test_whatever_an_env_raises_the_actor_stays(start: Start) -> None:
    """Its end included."""
    group, tokens = start(), Tokens()
    pid = pid_of(group, "faulty-1")
    for fault in (
        "system exit",
        "not an exception",
        "unpicklable",
        "unprintable",
        "odd constructor",
    ):
        with pytest.raises(EnvRaised, match="env 'faulty-1'"):
            group.step(tokens.steps(group.group.env_ids, {"faulty-1": fault}))
        group.reset(env_ids=["faulty-1"])
    assert pid_of(group, "faulty-1") == pid


@pytest.mark.parametrize("hang", ["sleep", "deadlock with the GIL", "stop"])
def test_an_actor_that_hangs_is_killed(start: Start, hang: str) -> None:
    """After the time that all envs of the call might have taken."""
    group, tokens = start(step_timeout=LIMIT), Tokens()
    watch = os.pidfd_open(pid_of(group, "faulty-1"))
    try:
        batch, _ = group.step(tokens.steps(group.group.env_ids, {"faulty-1": hang}))
        assert [marked(ret) for ret in batch.values()] == [True, True, False, False]
        assert batch.values()[1].info["worker_restarted"] == "hung in a step and was killed"
        assert select.select([watch], [], [], HANG)[0], "it lives"
    finally:
        os.close(watch)


TRAINER = """
import os, signal, sys
from kit.tokens import Tokens, two_workers
import rlightning_aio.sync
entry = two_workers(placement="ray", num_cpus=0, imports=["kit.faulty"])
group = rlightning_aio.sync.build_env_group(entry)
group.init(); group.reset()
pids = [group[env_id].call("returns", os.getpid) for env_id in group.env_ids]
group.step_async(Tokens().steps(group.env_ids, {"faulty-1": "sleep"}))
print(*pids, flush=True)
signal.pause()
"""


def test_actors_end_with_their_trainer(nodes: Any) -> None:
    """However that ends, and whatever they do."""
    process = subprocess.Popen(
        [sys.executable, "-c", TRAINER],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "RAY_ADDRESS": nodes.address},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    pids = set(map(int, process.stdout.readline().split()))
    watches = [os.pidfd_open(pid) for pid in pids]
    process.kill()
    process.wait()
    process.stdout.close()
    assert len(pids) == 2
    for watch in watches:
        assert select.select([watch], [], [], HANG)[0], "it lives"
        os.close(watch)


def test_a_signal_that_ends_the_tests_fails_none_of_them(nodes: Any) -> None:
    """Ray would have it raise `SystemExit` in one, and all others run without a cluster."""
    del nodes
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_envs_of_a_node_that_dies_begin_anew_on_another(nodes: Any, start: Start) -> None:
    """The envs of the other node have only stepped."""
    first, second = (ray_cluster.add_node(nodes, 1, sim=1) for _ in range(2))
    group, tokens = start(ray_options={"resources": {"sim": 1}}, max_restarts=20), Tokens()
    nodes.remove_node(first, allow_graceful=False)
    third = ray_cluster.add_node(nodes, 1, sim=1)
    lost: list[bool] = []
    while not any(lost):  # An actor lives for some steps more than its node.
        batch, _ = group.step(tokens.steps(group.group.env_ids))
        lost = [marked(ret) for ret in batch.values()]
    assert lost in ([True, True, False, False], [False, False, True, True])
    tokens.check(batch.take([k for k, gone in enumerate(lost) if not gone]))
    tokens.check(group.step(tokens.steps(group.group.env_ids))[0])
    group.close()
    for node in (second, third):
        nodes.remove_node(node)


def test_a_forked_process_leaves_the_cluster_alone(start: Start) -> None:
    """It has sockets to the cluster in its memory, and says nothing there."""
    group, tokens = start(), Tokens()
    for _ in range(5):
        pid = os.fork()
        if pid == 0:
            os._exit(0)
        assert os.waitpid(pid, 0)[1] == 0
        tokens.check(group.step(tokens.steps(group.group.env_ids))[0])
        assert len(ray_cluster.living_actors()) == 2


def test_a_replacement_without_a_place_says_what_it_lacks(nodes: Any) -> None:
    """It is waited for as long as any start may take."""
    node = ray_cluster.add_node(nodes, 1, only=1)
    placed = {"placement": "ray", "num_cpus": 0, "ray_options": {"resources": {"only": 1}}}
    pole = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", **placed}
    group = Driven("sync", {**pole, "max_restarts": 1})
    try:
        group.init()
        batch, _ = group.reset()
        # From here on; the first start may take what it needs on a busy machine.
        record = group.group._core.supervisor.records[0]
        record.config = record.config.model_copy(update={"start_timeout": 5.0})
        nodes.remove_node(node, allow_graceful=False)
        lacks = r"did not start again within 5\.0 s.*could not be placed: it asks for .*'only': 1"

        def step_on() -> None:
            while True:  # The actor lives for some steps more than its node.
                group.step(batch.respond(action=[0]))

        with pytest.raises(WorkerDied, match=lacks):
            step_on()
    finally:
        group.end()
