"""A worker that dies is noticed at once, reported with its cause, and replaced or raised."""

from __future__ import annotations

import logging
import os
import re
import resource
import signal
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import pytest
from kit.driven import Driven, kinds_on_both_drivers, on_one_driver
from kit.processes import fork_server_pid, kill, pid_of
from kit.tokens import Tokens, entry, marked, two_workers
from run_python import output_of

from rlightning_aio.errors import StartFailed, WorkerDied

if TYPE_CHECKING:
    from collections.abc import Callable

    Start: TypeAlias = Callable[..., Driven]

DEATHS = {
    "sigkill": "was killed by SIGKILL",
    "sigterm": "was killed by SIGTERM",
    "segfault": "was killed by SIGSEGV",
    "abort": "was killed by SIGABRT",
    "exit 0": "exited with code 0",
    "exit 3": "exited with code 3",
}
ELSEWHERE = ["sigkill", "segfault", "exit 3"]
"""One death of each kind, for places other than a step."""


@kinds_on_both_drivers("deaths", DEATHS)
def test_death_in_a_step_gives_one_marked_result_for_each_env_that_owed_one(
    start: Start, deaths: list[str]
) -> None:
    """Envs of the dead worker begin new episodes and report the cause; the other worker's just
    step.
    """
    group, tokens = start(two_workers()), Tokens()
    for death in deaths:
        group.reset()
        batch, _ = group.step(tokens.steps(group.group.env_ids, {"faulty-1": death}))
        assert batch.ids() == ["faulty-0", "faulty-1", "faulty-2", "faulty-3"]
        first, second, *others = batch.values()
        assert marked(second)
        assert second.info["worker_restarted"].startswith(DEATHS[death])
        assert not any(map(marked, others))
        if not marked(first):  # It had replied before the death; then its next step reports it.
            again, _ = group.step(tokens.steps(["faulty-0"]))
            assert marked(again.values()[0])
        batch, _ = group.step(tokens.steps(group.group.env_ids))
        tokens.check(batch)
        assert [ret.observation[3] for ret in batch.values()] == [1, 1, 2, 2]


@on_one_driver
def test_death_in_a_reset_with_options_is_answered_by_one_without(start: Start) -> None:
    """The options may have caused the death; the replacement's reset doesn't repeat them."""
    group = start(two_workers())
    batch, _ = group.reset(options={"fault": "segfault"}, env_ids=["faulty-2"])
    assert marked(batch.values()[0])


@kinds_on_both_drivers("deaths", ELSEWHERE)
def test_death_in_close_is_reported_and_does_not_delay_the_others(
    start: Start, deaths: list[str]
) -> None:
    """`close` returns, warns of the env and the cause, and leaves nothing running."""
    group = start(entry(1 + len(deaths), envs_per_process=1))
    dying = dict(zip(group.group.env_ids[1:], deaths, strict=True))
    for env_id, death in dying.items():
        group.call(env_id, "arm", "closing", death)
    with pytest.warns(UserWarning, match="raised WorkerDied") as caught:
        group.close()
    messages = sorted(str(warning.message) for warning in caught)
    for message, (env_id, death) in zip(messages, dying.items(), strict=True):
        assert env_id in message
        assert DEATHS[death] in message


@pytest.mark.parametrize(
    ("driver", "place", "death"),
    [("sync", "building", death) for death in ELSEWHERE]
    + [(driver, "spaces", ELSEWHERE[0]) for driver in ("sync", "uvloop")],
)
def test_death_while_starting_fails_the_start_with_its_cause(
    build: Start, place: str, death: str
) -> None:
    """`init` reports the env and the cause, and leaves nothing running."""
    group = build(two_workers(env_kwargs={"faults": {place: death}, "only": 3}))
    with pytest.raises(StartFailed, match="faulty-3") as caught:
        group.init()
    assert DEATHS[death] in str(caught.value)


@on_one_driver
def test_error_has_the_output_of_the_worker_and_its_stack(start: Start) -> None:
    """The Python stack at a segmentation fault, and what was printed before; of a sudden SIGKILL,
    which nothing else would explain, a hint at the out-of-memory killer.
    """
    group = start(entry(on_worker_death="raise", envs_per_process=1))
    group.call("faulty-0", "do", "print")
    with pytest.raises(WorkerDied) as caught:
        group.call("faulty-0", "do", "segfault")
    assert caught.value.exit_code == -signal.SIGSEGV
    assert "e" * 1000 in caught.value.stderr_tail
    assert "Segmentation fault" in caught.value.stderr_tail
    assert "in string_at" in caught.value.stderr_tail
    assert "in do" in str(caught.value)
    assert "a call of do()" in str(caught.value)
    with pytest.raises(WorkerDied, match="run out of memory"):
        group.call("faulty-1", "do", "sigkill")


@on_one_driver
def test_raise_names_the_env_that_was_being_executed(start: Start) -> None:
    """Of several envs in the worker, the error names the one that was stepping, not the first."""
    group, tokens = start(two_workers(on_worker_death="raise")), Tokens()
    with pytest.raises(WorkerDied, match="env 'faulty-3'") as caught:
        group.step(tokens.steps(group.group.env_ids[::-1], {"faulty-3": "exit 3"}))
    error = caught.value
    assert error.env_id == "faulty-3"
    assert "faulty-3" in error.env_ids
    assert error.exit_code == 3
    assert error.results is not None
    assert {"faulty-0", "faulty-1"} <= set(error.results.ids())
    tokens.check(error.results)


@on_one_driver
def test_a_raised_death_concerns_the_envs_of_its_worker(start: Start) -> None:
    """It is raised once, also where nothing was asked; the next request has a new worker."""
    group, tokens = start(two_workers(on_worker_death="raise")), Tokens()
    group.step_async(tokens.steps(group.group.env_ids, {"faulty-0": "exit 3"}))
    with pytest.raises(WorkerDied) as caught:
        group.collect_async(wait_all=True)
    assert set(caught.value.env_ids) == {"faulty-0", "faulty-1"}
    batch, _ = group.collect_async(wait_all=True)
    assert sorted(batch.ids()) == ["faulty-2", "faulty-3"]
    tokens.check(batch)
    batch, _ = group.step(tokens.steps(["faulty-2", "faulty-1"]))
    assert [marked(ret) for ret in batch.values()] == [False, True]
    kill(pid_of(group, "faulty-0"))
    while group.group.get_workers()[0]["state"] == "up":
        tokens.check(group.step(tokens.steps(["faulty-2"]))[0])
    with pytest.raises(WorkerDied, match=r"SIGKILL.*nothing was sent") as caught:
        group.step(tokens.steps(["faulty-2", "faulty-1"]))
    assert caught.value.env_ids == ("faulty-1",)
    batch, _ = group.step(tokens.steps(group.group.env_ids))
    assert [marked(ret) for ret in batch.values()] == [True, True, False, False]
    tokens.check(group.step(tokens.steps(group.group.env_ids))[0])


def test_others_continue_while_a_worker_is_replaced(start: Start, tmp_path: Path) -> None:
    """A replacement that is slow to build delays no other worker."""
    gate = tmp_path / "gate"
    group, tokens = start(two_workers(env_kwargs={"gate": str(gate)})), Tokens()
    os.mkfifo(gate)  # From now on, envs that are built wait here.
    group.step_async(tokens.steps(["faulty-0"], {"faulty-0": "sigkill"}))
    for _ in range(200):
        group.step_async(tokens.steps(["faulty-2", "faulty-3"]))
        batch, _ = group.collect_async(min_results=2)
        assert sorted(batch.ids()) == ["faulty-2", "faulty-3"]
        tokens.check(batch)
    gate.open("w").close()
    batch, _ = group.collect_async()
    assert marked(batch["faulty-0"])


@on_one_driver
def test_steps_of_a_neighbour_end_no_row_of_restarts(start: Start) -> None:
    """The error of an env that always kills its worker has the count and the cause."""
    group, tokens = start(entry(2, max_restarts=2)), Tokens()
    dies = tokens.steps(["faulty-1"], {"faulty-1": "exit 3"})
    for _ in range(2):
        assert marked(group.step(dies)[0].values()[0])
        for _ in range(2):  # The first is answered by a reset.
            group.step(tokens.steps(["faulty-0"]))
    with pytest.raises(WorkerDied, match=r"env 'faulty-1'.*exited with code 3.*2 restarts"):
        group.step(dies)


@on_one_driver
def test_replacement_that_cannot_be_built_is_raised_with_its_error(
    start: Start, tmp_path: Path
) -> None:
    """After the allowed number of attempts, the error has that of the constructor."""
    broken = tmp_path / "broken"
    kwargs = {"faults": {"building": "raise"}, "while_exists": str(broken)}
    group, tokens = start(two_workers(env_kwargs=kwargs, max_restarts=2)), Tokens()
    broken.touch()
    with pytest.raises(WorkerDied, match="could not be rebuilt: ValueError: as asked for"):
        group.step(tokens.steps(["faulty-0"], {"faulty-0": "exit 3"}))
    tokens.check(group.step(tokens.steps(["faulty-2", "faulty-3"]))[0])


@on_one_driver
@pytest.mark.parametrize(
    ("whose", "words"),
    [
        ("the trainer's", "can't start a worker for entry 'faulty'"),
        ("the fork server's", "could not be forked"),
    ],
)
def test_restarts_outlast_a_shortage_of_descriptors(
    start: Start, caplog: pytest.LogCaptureFixture, whose: str, words: str
) -> None:
    """Each attempt counts, and they become rarer; the other envs step meanwhile."""
    group, tokens = start(two_workers(max_restarts=99)), Tokens()
    pid = fork_server_pid(group.group) if whose == "the fork server's" else os.getpid()
    kept = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    listed = list(Path(f"/proc/{pid}/fd").iterdir())
    held = {int(path.name) for path in listed if path.is_symlink()}  # Not that of the listing.
    lowest_free = min(set(range(len(held) + 1)) - held)
    group.step_async(tokens.steps(["faulty-0"], {"faulty-0": "exit 3"}))
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (lowest_free, kept[1]))
    try:
        with caplog.at_level(logging.WARNING, "rlightning_aio"):
            while "in 0.2 s" not in caplog.text:
                tokens.check(group.step(tokens.steps(["faulty-2", "faulty-3"]))[0])
    finally:
        resource.prlimit(pid, resource.RLIMIT_NOFILE, kept)
    assert words in caplog.text
    assert re.search("Too many open files|too many are open", caplog.text)
    batch, _ = group.collect_async()
    assert marked(batch["faulty-0"])
    assert batch["faulty-0"].info["worker_restarted"] == "exited with code 3"
    again, _ = group.step(tokens.steps(["faulty-0", "faulty-1"]))
    assert [marked(ret) for ret in again.values()] == [False, True]


@on_one_driver
def test_a_worker_that_cannot_be_started_for_a_request_ends_it(start: Start) -> None:
    """The worker is tried when the request is sent, as those before are given up."""
    group, tokens = start(two_workers(max_restarts=0)), Tokens()
    with pytest.raises(WorkerDied, match="code 3"):
        group.step(tokens.steps(["faulty-0"], {"faulty-0": "exit 3"}))
    kept = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, kept[1]))
    try:
        with pytest.raises(WorkerDied, match="can't start a worker for entry 'faulty'"):
            group.reset(env_ids=["faulty-0"])
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, kept)
    assert marked(group.reset(env_ids=["faulty-0"])[0]["faulty-0"])


def test_worker_that_loses_its_channel_is_replaced(start: Start) -> None:
    """An env that closes a descriptor of the worker ends its worker only."""
    group, tokens = start(two_workers()), Tokens()
    first, _ = group.step(tokens.steps(["faulty-0"], {"faulty-0": "close descriptors"}))
    second, _ = group.step(tokens.steps(group.group.env_ids))
    # The result may have been reported before the worker needed the channel.
    assert marked(first["faulty-0"]) != marked(second["faulty-0"])
    assert marked(second["faulty-1"])
    tokens.check(group.step(tokens.steps(group.group.env_ids))[0])


@on_one_driver
def test_worker_that_is_interrupted_while_idle_is_replaced(start: Start) -> None:
    """The interrupt hit the runtime, not an env, so its effect is unknown."""
    group, tokens = start(two_workers()), Tokens()
    os.kill(pid_of(group, "faulty-0"), signal.SIGINT)
    batch, _ = group.step(tokens.steps(group.group.env_ids))
    assert [ret.env_id for ret in batch.values()] == group.group.env_ids
    group.reset()
    tokens.check(group.step(tokens.steps(group.group.env_ids))[0])


@on_one_driver
def test_stacks_of_a_crash_appear_once(
    start: Start, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    """The worker writes them to stderr; the log has one line for a restart, an error has both."""
    group, tokens = start(two_workers(max_restarts=1)), Tokens()
    with caplog.at_level(logging.WARNING, "rlightning_aio"):
        group.step(tokens.steps(group.group.env_ids, {"faulty-2": "segfault"}))
    (record,) = caplog.records
    text = record.getMessage()
    assert "\n" not in text
    assert all(said in text for said in ("faulty-2", "was killed by SIGSEGV", "restart 1 of 1"))
    assert capfd.readouterr().err.count("Fatal Python error: Segmentation fault") == 1
    with pytest.raises(WorkerDied, match="most recent call first"):
        group.step(tokens.steps(["faulty-2"], {"faulty-2": "segfault"}))


def test_handling_a_death_imports_no_module() -> None:
    """An import needs descriptors, and at a death there may be none left."""
    tests = str(Path(__file__).parents[1])
    script = f"""
import sys
sys.path.insert(0, {tests!r})
from kit.tokens import Tokens, two_workers
import rlightning_aio.sync
with rlightning_aio.sync.build_env_group(two_workers()) as group:
    tokens = Tokens()
    batch, _ = group.step(tokens.steps(group.env_ids))
    before = set(sys.modules)
    batch, _ = group.step(tokens.steps(group.env_ids, {{"faulty-0": "sigkill"}}))
    assert batch.restarted.any()
    print(*sorted(set(sys.modules) - before))
"""
    assert output_of("-c", script).split() == []


@on_one_driver
def test_group_of_many_workers_starts_and_closes(build: Start) -> None:
    """More workers than a socket queues messages for block nothing."""
    group = build(entry(40, envs_per_process=1))
    group.init()
    batch, _ = group.reset()
    assert len({ret.observation[1] for ret in batch.values()}) == 40
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        group.close()
