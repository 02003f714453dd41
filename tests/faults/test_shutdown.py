"""No worker outlives its group or its trainer by more than two seconds.

The waits in the library add up to less. How long the machine takes for the rest is not tested; the
tests only check that everything ends by itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import pytest
from kit.driven import Driven
from kit.processes import fork_server_pid
from kit.tokens import Tokens, two_workers
from patience import HANG

import rlightning_aio
from rlightning_aio._core.hosts import times
from rlightning_aio.errors import GroupClosed

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    Start: TypeAlias = Callable[..., Driven]


def test_all_waits_in_the_library_take_less_than_two_seconds() -> None:
    """For envs that close, for the report of a kill, and for workers whose trainer is gone."""
    assert times.CLOSE + times.GRACE < 2.0
    assert times.CLOSE_ALONE < 2.0


SCRIPT = """
import os, signal, sys, time
from kit.processes import kill, pid_of
from kit.tokens import Tokens, entry, two_workers
import rlightning_aio, rlightning_aio.sync
def build(**fields):
    return rlightning_aio.sync.build_env_group(two_workers(**fields))
def say(text):
    print(text, flush=True)
def say_asleep():
    print("asleep", file=sys.stderr, flush=True)
tokens = Tokens()
"""


def descendants(pid: int) -> set[int]:
    """Return the children of a process, and theirs."""
    found: set[int] = set()
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        for children in Path(f"/proc/{pid}/task").glob("*/children"):
            for child in map(int, children.read_text().split()):
                found |= {child} | descendants(child)
    return found


def processes_of(group: rlightning_aio.EnvGroup) -> set[int]:
    """Return the group's workers and their fork server."""
    server: int = fork_server_pid(group)
    return {server} | descendants(server)


@contextlib.contextmanager
def watched(pids: set[int]) -> Iterator[Callable[[], None]]:
    """Yield a function that fails unless all of `pids` end."""
    watches: dict[int, int] = {}
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):  # The process has ended already.
            watches[pid] = os.pidfd_open(pid)

    def ended() -> None:
        left = dict(watches)
        until = time.monotonic() + HANG
        while left:
            ready, _, _ = select.select(left.values(), [], [], max(0.0, until - time.monotonic()))
            assert ready, f"still alive: {sorted(left)}"
            left = {pid: watch for pid, watch in left.items() if watch not in ready}

    try:
        yield ended
    finally:
        for watch in watches.values():
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(watch, signal.SIGKILL)
            os.close(watch)


@contextlib.contextmanager
def trainer(script: str, *arguments: str, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """Run a trainer in its own process."""
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT + textwrap.dedent(script), *arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        text=True,
        stdin=subprocess.PIPE,
        **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options},
    )
    try:
        yield process
    finally:
        process.kill()
        for stream in (process.stdin, process.stdout, process.stderr):
            if stream is not None:
                stream.close()
        process.wait()


def read_until(stream: Any, text: str) -> list[str]:
    """Return the lines up to one that contains `text`."""
    lines: list[str] = []
    for line in stream:
        lines.append(line)
        if text in line:
            return lines
    raise AssertionError(f"no {text!r} in {lines}")


MOMENTS = {
    "idle": """
        group = build(); group.init(); group.reset()
        say_asleep()
        signal.pause()
    """,
    "stepping": """
        group = build(); group.init(); group.reset()
        group.step_async(tokens.steps(group.env_ids, {"faulty-1": "report and sleep"}))
        group.collect_async(wait_all=True)
    """,
    "looping in C": """
        group = build(); group.init(); group.reset()
        group.step_async(tokens.steps(group.env_ids, {"faulty-1": "loop in C"}))
        say_asleep()
        group.collect_async(wait_all=True)
    """,
    "starting": """
        build(env_kwargs={"faults": {"building": "report and sleep"}, "only": 3}).init()
    """,
    "importing": """
        from rlightning_aio import registry
        registry.BACKENDS["faulty"] = registry.Backend(
            "faulty", "kit.faulty:FaultyEnv", "faults",
            preload=("faults.hanging_import",),
        )
        build().init()
    """,
    "closing": """
        group = build(); group.init()
        group["faulty-2"].call("arm", "closing", "report and sleep")
        group.close()
    """,
    "restarting": """
        faults = {"faults": {"building": "report and sleep"}, "while_exists": sys.argv[1]}
        group = build(env_kwargs=faults); group.init(); group.reset()
        open(sys.argv[1], "w").close()
        group.step_async(tokens.steps(group.env_ids, {"faulty-1": "sigkill"}))
        group.collect_async(wait_all=True)
    """,
    "with a child of its own": """
        group = build(); group.init(); group.reset()
        child = os.fork()
        if child == 0:
            sys.stdin.read()  # It holds what descriptors the trainer held.
            os._exit(0)
        print(child, flush=True)
        say_asleep()
        signal.pause()
    """,
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_killed_trainer_takes_its_workers_along(moment: str, tmp_path: Path) -> None:
    """SIGKILL leaves no time for messages; all workers notice it, at every moment."""
    with trainer(MOMENTS[moment], str(tmp_path / "switch")) as process:
        assert process.stderr is not None
        assert process.stdout is not None
        assert process.stdin is not None
        read_until(process.stderr, "asleep")
        workers = descendants(process.pid)
        if moment == "with a child of its own":
            workers.remove(int(process.stdout.readline()))
        # The others may have closed already.
        assert len(workers) in {"importing": (1,), "closing": (2, 3)}.get(moment, (3,))
        for pid in (process.pid, *workers):
            # Some of these may be closing.
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                assert "/dev/shm/" not in Path(f"/proc/{pid}/maps").read_text()
        with watched(workers) as ended:
            process.kill()
            ended()
        process.stdin.close()
        last_words = process.stderr.read()
    if moment in ("idle", "with a child of its own"):
        # A robot's safe stop: every env was closed in time.
        assert last_words.count("is left alone") == 4


@pytest.mark.parametrize("kind", ["closing", "closing, awaitable"])
def test_envs_whose_trainer_dies_are_stopped_once_and_closed_once(
    kind: str, tmp_path: Path
) -> None:
    """In this order; an env that took another's place as well."""
    script = """
        from faults.closing import HANG, IMPORTS
        kind, folder = sys.argv[1:]
        fields = {"name": "e", "backend": kind, "env_kwargs": {"folder": folder}, **IMPORTS}
        fields |= {"num_workers": 2, "envs_per_process": 2}
        if "awaitable" in kind:
            fields["step_timeout"] = 0.1
        group = rlightning_aio.sync.build_env_group(fields)
        group.init()
        batch, _ = group.reset()
        if "awaitable" in kind:
            batch, _ = group.step(batch.respond(action=[0, HANG]))
            assert batch.restarted.tolist() == [False, True]
        say("ready")
        signal.pause()
    """
    with trainer(script, kind, str(tmp_path)) as process:
        assert process.stdout is not None
        read_until(process.stdout, "ready")
        with watched(descendants(process.pid)) as ended:
            process.kill()
            ended()
    ends = ["left alone", "closed"]
    replaced = ["closed"] if "awaitable" in kind else []
    for env_id, expected in {"e-0": ends, "e-1": [*replaced, *ends]}.items():
        assert (tmp_path / env_id).read_text().splitlines() == expected


LEFT_OPEN = {
    "the end of the script": "",
    "sys.exit": "sys.exit(3)",
    "an exception": "raise ValueError('the end')",
    "os._exit": "os._exit(4)",
    "forgetting the group": "del group; say('forgotten'); sys.stdin.read()",
    "an interrupt": "import signal; signal.raise_signal(signal.SIGINT)",
    "a termination": "import signal; signal.raise_signal(signal.SIGTERM)",
}


@pytest.mark.parametrize("end", LEFT_OPEN)
def test_a_group_that_is_not_closed_ends_with_its_owner(end: str) -> None:
    """However a program ends, it leaves no workers behind, and they don't keep it from ending."""
    script = f"""
        group = build(); group.init(); group.reset()
        group.step_async(tokens.steps(group.env_ids))
        say("ready")
        sys.stdin.readline()
        {LEFT_OPEN[end]}
    """
    with trainer(script) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        read_until(process.stdout, "ready")
        with watched(descendants(process.pid)) as ended:
            process.stdin.write("go\n")
            process.stdin.flush()
            ended()
        process.stdin.close()
        assert process.wait(HANG) == {
            "sys.exit": 3,
            "an exception": 1,
            "os._exit": 4,
            "an interrupt": -signal.SIGINT,
            "a termination": -signal.SIGTERM,
        }.get(end, 0)


STREAMS = {
    "no stderr": ("2>&-", ""),
    "none": ("0<&- 1>&- 2>&-", ""),
    "none since it was built": ("", "os.closerange(0, 3)"),
}


@pytest.mark.parametrize("streams", STREAMS)
def test_program_without_standard_streams_trains_like_any_other(
    streams: str, tmp_path: Path
) -> None:
    """No descriptor of the library takes the number of stderr, in any process."""
    script, said = tmp_path / "script.py", tmp_path / "said"
    redirected, closed = STREAMS[streams]
    script.write_text(
        SCRIPT
        + textwrap.dedent(f"""
        def say(text):
            with open(sys.argv[1], "a") as said:
                said.write(text + "\\n")
        group = build()
        {closed}
        group.init()
        group.reset()
        for _ in range(3):
            tokens.check(group.step(tokens.steps(group.env_ids, {{"faulty-0": "print"}}))[0])
        batch, _ = group.step(tokens.steps(group.env_ids, {{"faulty-0": "segfault"}}))
        say(batch["faulty-0"].info["worker_restarted"])
        os.write(2, b"into nothing")
        tokens.check(group.step(tokens.steps(group.env_ids))[0])
        group.close()
        say("closed")
    """)
    )
    program = ["sh", "-c", f'exec "$@" {redirected}', "sh", sys.executable, str(script), str(said)]
    path = os.pathsep.join(sys.path)
    subprocess.run(program, env={**os.environ, "PYTHONPATH": path}, check=True, timeout=HANG)
    assert said.read_text() == "was killed by SIGSEGV\nclosed\n"


def test_an_unread_stderr_delays_nobody() -> None:
    """Neither an env that prints to it nor the news of deaths; what it can't take is dropped."""
    script = """
        import logging
        logging.disable()
        group = build(); group.init(); group.reset()
        group.step_async(tokens.steps(["faulty-0"], {"faulty-0": "print"}))
        for _ in range(3):
            batch, _ = group.step(tokens.steps(["faulty-3"], {"faulty-3": "exit 3"}))
            say(batch["faulty-3"].info["worker_restarted"])
            tokens.check(group.step(tokens.steps(["faulty-3"]))[0])
        batch, _ = group.collect_async()
        tokens.check(batch)
        say("printed by " + batch.ids()[0])
        group.close()
        say("closed")
    """
    with trainer(script) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        lines = read_until(process.stdout, "closed")
        assert sum("exited with code 3" in line for line in lines) == 3
        assert any("printed by faulty-0" in line for line in lines)
        written = process.stderr.read()
    assert 0 < written.count("e" * 1023 + "\n") < 3000


USES_IN_A_CHILD = """
async def use_in_child(group):
    for use in (
        lambda: group.init(),
        lambda: group.reset(),
        lambda: group.step(tokens.steps(group.env_ids)),
        lambda: group.step_async(tokens.steps(group.env_ids)),
        lambda: group.collect_async(),
        lambda: group["faulty-0"].call("do", "nothing"),
        lambda: group.close(),
    ):
        try:
            given = use()
            if inspect.iscoroutine(given):
                await given
        except RLightningError as error:
            assert f"belongs to process {os.getppid()}, which has forked this one" in str(error)
        else:
            raise AssertionError("it was of use")
"""


@pytest.mark.parametrize("driver", ["sync", "asyncio"])
def test_child_of_the_trainer_can_not_use_its_group(driver: str) -> None:
    """Calls are refused with a reason; leaving a `with` block and exiting have no effect on it."""
    module, wait = ("rlightning_aio.sync", "") if driver == "sync" else ("rlightning_aio", "await")
    context = "with" if driver == "sync" else "async with"
    script = f"""
        import asyncio, inspect
        from rlightning_aio.errors import RLightningError
        {textwrap.indent(USES_IN_A_CHILD, "        ").strip()}
        async def main():
            never_started = {module}.build_env_group(two_workers())
            {context} {module}.build_env_group(two_workers()) as group:
                {wait}(group.reset())
                group.step_async(tokens.steps(group.env_ids))
                child = os.fork()
                if child == 0:
                    await use_in_child(never_started)
                    await use_in_child(group)
                    return
                assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
                batch, _ = {wait}(group.collect_async(wait_all=True))
                tokens.check(batch)
                for _ in range(3):
                    batch, _ = {wait}(group.step(tokens.steps(group.env_ids)))
                    tokens.check(batch)
                kill({wait}(group["faulty-0"].call("returns", os.getpid)))
                batch, _ = {wait}(group.step(tokens.steps(group.env_ids)))
                say(batch["faulty-0"].info["worker_restarted"])
            {wait}(never_started.init())
            {wait}(never_started.close())
            say("closed")
        asyncio.run(main())
    """
    with trainer(script, stderr=None) as process:
        assert process.stdout is not None
        assert "SIGKILL" in "".join(read_until(process.stdout, "closed"))
        assert process.wait(HANG) == 0


async def test_cancelled_close_still_closes() -> None:
    """No later call would finish it."""
    group = rlightning_aio.build_env_group(two_workers())
    await group.init()
    await group["faulty-0"].call("arm", "closing", "sleep")
    with watched(processes_of(group)) as ended:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(group.close(), 0.05)
        ended()
    await group.close()


async def test_start_can_be_closed_from_another_task() -> None:
    """The call that starts it raises GroupClosed."""
    # Its workers close once they have started, which takes long on a busy machine.
    group = rlightning_aio.build_env_group(two_workers(close_timeout=HANG))
    starting = asyncio.ensure_future(group.init())
    await asyncio.sleep(0)
    await group.close()
    with pytest.raises(GroupClosed):
        await starting


def test_replaced_workers_leave_no_zombies(start: Start) -> None:
    """Dead workers are reaped, and their descriptors are closed."""
    group, tokens = start(two_workers(max_restarts=100)), Tokens()
    server = fork_server_pid(group.group)

    def held() -> tuple[int, int, int]:
        return (
            len(processes_of(group.group)),
            len(list(Path("/proc/self/fd").iterdir())),
            len(list(Path(f"/proc/{server}/fd").iterdir())),
        )

    before = held()
    for _ in range(8):
        group.step(tokens.steps(group.group.env_ids, {"faulty-1": "exit 3"}))
        # A step between two deaths, so that the next restart needs no pause.
        group.step(tokens.steps(group.group.env_ids))
    group.reset()
    tokens.check(group.step(tokens.steps(group.group.env_ids))[0])
    assert held() == before


@pytest.mark.parametrize("waiting", ["init", "step"])
def test_close_from_a_signal_handler_ends_the_wait_that_it_interrupts(waiting: str) -> None:
    """As from another task: the wait raises GroupClosed."""
    places = {"building": "call the trainer"} if waiting == "init" else {}
    group, tokens = Driven("sync", two_workers(env_kwargs={"faults": places, "only": 1})), Tokens()
    before = signal.signal(signal.SIGUSR1, lambda *_: group.close())
    try:
        if waiting == "step":
            group.init()
            group.reset()
        steps = tokens.steps(group.group.env_ids, {"faulty-1": "call the trainer"})
        with pytest.raises(GroupClosed, match="closed while"):
            _ = group.init() if waiting == "init" else group.step(steps)
    finally:
        signal.signal(signal.SIGUSR1, before)
        group.end()
