"""Any error of an env arrives as `EnvRaised` with its traceback, and the env stays usable."""

from __future__ import annotations

import builtins
import os
import re
import select
import sys
import threading
import types
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pytest
from kit.driven import Driven, on_one_driver
from kit.scripted import Counts
from kit.tokens import Tokens, entry, two_workers
from patience import HANG

from rlightning_aio.errors import EnvRaised, RemoteTraceback, StartFailed

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Start: TypeAlias = Callable[..., Driven]

# Errors, and how they are reported: type and text.
RAISED = {
    "raise": ("ValueError", "as asked for"),
    "odd constructor": ("kit.faulty.OddConstructor", "code 7 in step"),
    "unpicklable": ("kit.faulty.Unpicklable", "it holds a lock"),
    "unprintable": ("kit.faulty.Unprintable", "<its __str__ raised RuntimeError>"),
    "unspeakable": ("kit.faulty.Unspeakable", "<its __str__ raised SystemExit>"),
    "oddly spoken": ("kit.faulty.OddlySpoken", "odd words"),
    "wordless": ("kit.faulty.Wordless", "<its __str__ raised TypeError>"),
    "oddly pickled": ("kit.faulty.OddlyPickled", "as it is"),
    "untraceable": ("kit.faulty.Untraceable", "from nowhere"),
    "not an exception": ("kit.faulty.NotAnException", "but raised"),
    "system exit": ("SystemExit", "5"),
    "keyboard interrupt": ("KeyboardInterrupt", ""),
    "interrupt": ("KeyboardInterrupt", ""),
    "generator exit": ("GeneratorExit", ""),
    "stop iteration": ("StopIteration", "1"),
    "group of one": ("KeyError", "'the task'"),
    "surrogates": ("ValueError", "\udcff"),
    "a megabyte": ("ValueError", "x" * 2**20),
    "broken pipe": ("BrokenPipeError", "the simulator's, not ours"),
    "recursion": ("RecursionError", "maximum recursion depth exceeded"),
    "memory": ("MemoryError", ""),
}


def check_error(error: EnvRaised, name: str, place: str) -> None:
    """Check that the error has type, text and place, and the remote traceback above its own."""
    type_name, text = RAISED[name]
    assert error.env_id == "faulty-1"
    assert error.exception_type == type_name
    assert error.exception_text == text
    assert (
        f"env 'faulty-1' (entry 'faulty', backend faulty, task 'anything') raised in {place}"
        in (str(error))
    )
    assert "faulty.py" in error.traceback_text
    assert isinstance(error.__cause__, RemoteTraceback)
    builtin = getattr(builtins, type_name, BaseException)
    passes_generators = issubclass(builtin, Exception) and builtin is not StopIteration
    assert isinstance(error, builtin) == passes_generators or builtin is BaseException


@pytest.mark.parametrize("placement", ["process", "inline"])
def test_whatever_an_env_raises_is_reported_and_it_stays_usable(
    start: Start, placement: str
) -> None:
    """In a step, in a call, and in a reset: with options, which go through the channel, and
    without, when the row has the seed. The other envs of a batch have their results.
    """
    place = {"placement": "inline"} if placement == "inline" else {"envs_per_process": 2}
    group, tokens = start(entry(4, **place)), Tokens()
    pids = [ret.observation[1] for ret in group.reset()[0].values()]
    for name in RAISED:
        if placement == "inline" and RAISED[name][0] == "KeyboardInterrupt":
            continue  # That is the program's own.
        with pytest.raises(EnvRaised) as caught:
            group.step(tokens.steps(group.group.env_ids, {"faulty-1": name}))
        check_error(caught.value, name, "step")
        assert caught.value.results is not None
        assert caught.value.results.ids() == ["faulty-0", "faulty-2", "faulty-3"]
        tokens.check(caught.value.results)
        with pytest.raises(EnvRaised) as caught:
            group.call("faulty-1", "do", name)
        check_error(caught.value, name, "the call of do()")
        for options in ({"fault": name}, None):
            if options is None:
                group.call("faulty-1", "arm", "resetting", name)
            with pytest.raises(EnvRaised) as caught:
                group.reset(seed=1, options=options, env_ids=["faulty-1"])
            check_error(caught.value, name, "reset")
        group.call("faulty-1", "arm", "resetting", "nothing")
        group.reset(env_ids=["faulty-1"])
        batch, _ = group.step(tokens.steps(group.group.env_ids))
        tokens.check(batch)
    assert [ret.observation[1] for ret in batch.values()] == pids


@on_one_driver
def test_a_debugger_in_a_worker_says_where_it_has_a_terminal(build: Start) -> None:
    """In a step, and while the env is built."""
    group, tokens = build(two_workers()), Tokens()
    group.init()
    group.reset()
    where = r"a worker has no terminal: debug with placement='inline'"
    with pytest.raises(EnvRaised, match=rf"raised in step: bdb.BdbQuit \({where}\)"):
        group.step(tokens.steps(group.group.env_ids, {"faulty-1": "debug"}))
    with pytest.raises(StartFailed, match=rf"could not be built: bdb.BdbQuit \({where}\)"):
        build(entry(env_kwargs={"faults": {"building": "debug"}})).init()


ODDLY_RAISED = ["system exit", "odd constructor", "unpicklable", "unspeakable", "oddly spoken"]
"""For tests that need a group for each: all of `RAISED` is reported in the same way."""


@pytest.mark.parametrize(
    ("driver", "place", "name"),
    [("sync", "building", name) for name in ODDLY_RAISED]
    + [(driver, "spaces", ODDLY_RAISED[0]) for driver in ("sync", "uvloop")],
)
def test_an_error_while_starting_fails_the_start(build: Start, place: str, name: str) -> None:
    """`init` names the env and has the remote traceback; nothing is left running."""
    type_name, text = RAISED[name]
    group = build(two_workers(env_kwargs={"faults": {place: name}, "only": 1}))
    with pytest.raises(StartFailed) as caught:
        group.init()
    assert caught.value.env_id == "faulty-1"
    assert f"could not be built: {type_name}: {text}" in str(caught.value)
    assert "faulty.py" in str(caught.value.__cause__)


@on_one_driver
def test_an_error_of_close_is_a_warning_and_others_are_closed(start: Start) -> None:
    """The program can't do anything about it, but should know."""
    group = start(entry(len(ODDLY_RAISED)))
    for env_id, name in zip(group.group.env_ids, ODDLY_RAISED, strict=True):
        group.call(env_id, "arm", "closing", name)
    with pytest.warns(UserWarning, match="close") as caught:
        group.close()
    for env_id, name, warning in zip(group.group.env_ids, ODDLY_RAISED, caught, strict=True):
        type_name, text = RAISED[name]
        assert f"close() of env {env_id!r} raised {type_name}: {text}" in str(warning.message)


CHILDREN = ["fork and raise", "fork and return", "fork and exit"]


@on_one_driver
def test_children_that_an_env_forks_send_no_replies(
    build: Start, capfd: pytest.CaptureFixture[str]
) -> None:
    """They end when they return from the env's code; only the env itself replies."""
    faults = {"building": "fork and raise", "spaces": "fork and return"}
    group, tokens = build(two_workers(env_kwargs={"faults": faults})), Tokens()
    group.init()
    group.reset()
    for name in CHILDREN:
        batch, _ = group.step(tokens.steps(group.group.env_ids, {"faulty-1": name}))
        tokens.check(batch)
        batch, _ = group.reset(options={"fault": name}, env_ids=["faulty-1"])
        assert batch.ids() == ["faulty-1"]
        group.call("faulty-1", "arm", "resetting", name)
        group.reset()
        group.call("faulty-1", "arm", "resetting", "nothing")
        assert group.call("faulty-1", "do", name) == f"faulty-1 did {name}"
    group.call("faulty-1", "arm", "closing", "fork and return")
    tokens.check(group.step(tokens.steps(group.group.env_ids))[0])
    group.close()
    written = capfd.readouterr().err
    assert "ValueError: in a child" in written
    assert "os._exit" in written


@on_one_driver
def test_child_of_an_env_writes_into_no_row(start: Start, tmp_path: Path) -> None:
    """However late it returns, its copy of the shared memory is private."""
    gate = tmp_path / "gate"
    os.mkfifo(gate)

    def forked() -> np.ndarray:
        child = os.fork()
        if child == 0:
            gate.read_bytes()
        return np.full(5, child, float)

    group, tokens = start(entry(1), zero_copy=True), Tokens()
    group.call("faulty-0", "answer_with", observation=forked)
    batch, _ = group.step(tokens.steps(["faulty-0"]))
    child = int(batch.observation[0, 0])
    watch = os.pidfd_open(child)
    gate.open("w").close()
    assert select.select([watch], [], [], HANG)[0], "the child is still alive"
    os.close(watch)
    assert batch.observation.tolist() == [[child] * 5]
    tokens.check(group.step(tokens.steps(["faulty-0"]))[0])


def _foreign() -> Any:
    """Return an object of a module that only this process has."""
    module = types.ModuleType("nobody_else_has_this")
    exec("class Thing: pass", module.__dict__)
    sys.modules[module.__name__] = module
    return module.Thing()


@on_one_driver
def test_value_that_cannot_be_pickled_is_an_error_of_its_call(start: Start) -> None:
    """So is one that can't be unpickled in the trainer; nothing else breaks."""
    group, tokens = start(two_workers()), Tokens()
    with pytest.raises(EnvRaised, match=r"call of returns\(\).*what it returned can't be pickled"):
        group.call("faulty-1", "returns", threading.Lock)
    with pytest.raises(EnvRaised, match="nobody_else_has_this"):
        group.call("faulty-1", "returns", _foreign)
    tokens.check(group.step(tokens.steps(group.group.env_ids))[0])


MISFITS: dict[str, tuple[dict[str, Any], str]] = {
    "shape": (
        {"observation": lambda: np.zeros((2, 3))},
        r"expected shape \(5,\) and dtype float64, found shape \(2, 3\) and dtype float64",
    ),
    "dtype": (
        {"observation": lambda: np.zeros(5, complex)},
        r"expected shape \(5,\) and dtype float64, found shape \(5,\) and dtype complex128",
    ),
    "text": (
        {"observation": lambda: "five"},
        r"expected shape \(5,\) and dtype float64, found shape \(\) and dtype <U4",
    ),
    "nothing": (
        {"observation": lambda: None},
        r"expected shape \(5,\) and dtype float64, found None",
    ),
    "ragged": ({"observation": lambda: [[1], [1, 2]]}, "found a value of type list"),
    "reward": ({"last_reward": lambda: np.zeros(3)}, r"reward .* shape \(3,\), expected \(\)"),
    "reward of no number": ({"last_reward": lambda: "much"}, "much"),
    "result": (
        {"result": lambda: (1, 2)},
        "must return an EnvRet or a MultiAgentEnvRet, not tuple",
    ),
    "no result": ({"result": lambda: None}, "must return an EnvRet .*, not NoneType"),
}


@on_one_driver
def test_observation_that_does_not_fit_its_space_is_named_with_both_shapes(start: Start) -> None:
    """The error has expected and found shape and dtype; the env is still usable."""
    group, tokens = start(two_workers()), Tokens()
    for instead, message in MISFITS.values():
        group.call("faulty-1", "answer_with", **instead)
        with pytest.raises(EnvRaised, match=message) as caught:
            group.step(tokens.steps(group.group.env_ids))
        assert caught.value.results is not None
        tokens.check(caught.value.results)
        group.reset(env_ids=["faulty-1"])
        tokens.check(group.step(tokens.steps(group.group.env_ids))[0])


@on_one_driver
def test_megabytes_on_stdout_and_stderr_change_nothing(
    start: Start, capfd: pytest.CaptureFixture[str]
) -> None:
    """They reach the trainer's stdout and stderr; the step is an ordinary one."""
    group, tokens = start(two_workers()), Tokens()
    for _ in range(2):
        batch, _ = group.step(
            tokens.steps(group.group.env_ids, dict.fromkeys(group.group.env_ids, "print"))
        )
        tokens.check(batch)
    group.close()
    written = capfd.readouterr()
    assert written.out.count("o") == written.err.count("e") == 2 * 4 * 3000 * 1023
    assert not written.out.count("e")


def local_env(reward: Callable[[Any], float]) -> Callable[[], Counts]:
    """Return a maker of an env of a class that no worker can import."""

    class Local(Counts):
        def __init__(self) -> None:
            self.does = reward

        def replace(self, new_reward: Callable[[Any], float]) -> None:
            self.does = new_reward

    return Local


@on_one_driver
@pytest.mark.parametrize("way", ["env", "preprocess_fn", "argument", "restored state"])
def test_the_traceback_of_code_that_no_worker_can_import(start: Start, way: str) -> None:
    """It names the file and shows the source, however the code got there."""

    def fails(_: Any) -> float:
        return 1.0 // 0  # Shown.

    def works(_: Any) -> float:
        return 1.0

    local = {
        "name": "local",
        "task": local_env(works if way in ("preprocess_fn", "argument") else fails),
    }
    group = start(local, preprocess_fn=fails if way == "preprocess_fn" else None)
    batch, _ = group.reset()
    if way == "argument":
        group.call("local-0", "replace", fails)
    elif way == "restored state":
        group.restore(group.snapshot())
    with pytest.raises(EnvRaised) as caught:
        group.step(batch.respond(action=[0]))
    shown = caught.value.traceback_text
    assert re.search(rf'File "{re.escape(__file__)}", line \d+, in fails\n .*# Shown\.\n', shown)
    assert "dynamic-code" not in shown
