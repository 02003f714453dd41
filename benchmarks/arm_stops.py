"""How far does a robot arm travel after something goes wrong?

    python benchmarks/arm_stops.py
    python benchmarks/arm_stops.py --events HUP KILL --places client --during reset --speed 50

Three simulated Piper arms, one for each kind of safe stop, are moving to a far target, by steps or
by a reset, when a process gets a signal (the trainer of workers, the workers, a trainer whose arms
are inline, `rollout` and `eval` with either, clients, or their trainer), or an action or a picture
is wrong. Ctrl-C and Ctrl-Z reach all processes of a terminal's foreground. The arms are on
pseudo-terminals; their clocks give the times. Needs ``rlightning-aio[piper]``.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio import sync
from rlightning_aio.errors import BadAction, EnvFault

if TYPE_CHECKING:
    from collections.abc import Iterator

STOPS = ("hold", "emergency_stop", "disable")
SIGNALS = ("HUP", "INT", "TERM", "QUIT", "SEGV", "KILL", "STOP")
TERMINAL = {"Ctrl-C": "INT", "Ctrl-Z": "TSTP"}
EVENTS = ("beyond", "none", "raises", "no picture", "hangs")
"""Of a step: an action outside its space, no action; a camera that raises, returns None, hangs."""
COMMANDS = {"rollout": ["--steps", "100000"], "eval": ["--episodes", "1000"]}
DURING = ("step", "reset")
ROWS = [
    *itertools.product(("trainer", "worker", "inline", "client", "server"), SIGNALS, DURING),
    *itertools.product(("trainer", "inline", "client", "server"), TERMINAL, DURING),
    *itertools.product(("trainer", "inline", "server"), EVENTS, DURING[:1]),
    *itertools.product(
        [f"{name}{of}" for name in COMMANDS for of in ("", " of workers")],
        ("INT", "TERM", "KILL", *TERMINAL),
        DURING,
    ),
]
"""Where something happens, what, and during what."""
FAR = [2.5, 3.0, -2.9, 1.7, 1.2, 2.0]
PATIENCE = 60.0
TROUBLE = Path(os.environ.get("ARM_STOPS_TROUBLE", "/nowhere"))
"""A file that holds the event, once it has happened."""


def happened() -> str:
    return TROUBLE.read_text() if TROUBLE.exists() else ""


def read_picture() -> dict[str, Any]:
    if (event := happened()) == "raises":
        raise OSError("the camera was unplugged")
    if event == "hangs":
        time.sleep(PATIENCE)
    return {"wrist": None if event == "no picture" else np.zeros((48, 64, 3), np.uint8)}


def _default_signals() -> None:
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT):
        signal.signal(number, signal.SIG_DFL)


def entry(stop: str, channel: str, placement: str, during: str, speed: int) -> dict[str, Any]:
    options = {
        "can_interface": "slcan",
        "channel": channel,
        "speed": speed,
        "gripper": False,
        "safe_stop": stop,
        "reset_joints": FAR if during == "reset" else [0.0] * 6,
        "cameras": {"read": "arm_stops:read_picture", "images": {"wrist": [48, 64, 3]}},
        # Long, because the machine may be busy; the watchdog's time is what is measured.
        "feedback_timeout": 20.0,
        "connect_timeout": 60.0,
    }
    place = {"placement": placement, "env_kwargs": options}
    return {"name": stop, "backend": "piper", "task": "stops", **place}


def drive(entries: list[dict[str, Any]], during: str) -> None:
    """Run a trainer with these entries; print when its arms move, and the outcome."""
    with sync.build_env_group(entries) as group:
        if entries[0]["backend"] == "env_server":
            print(group["arms-0"].address, flush=True)
        if during == "reset":
            print("moving", flush=True)
        batch, _ = group.reset()
        while batch or group.pending:  # None waits for another, whose camera may hang.
            factor = {"none": None, "beyond": 9}.get(happened(), 1)
            try:
                if batch:
                    actions = factor and np.array([FAR] * len(batch)) * factor
                    group.step_async(batch.respond(action=actions))
                batch, _ = group.collect_async()
                print("moving", flush=True)
            except (EnvFault, BadAction) as fault:
                batch = getattr(fault, "results", None)  # The other arms go on.
        sys.stdin.read()


def arms() -> tuple[Any, Any]:
    """Return the simulation, with which the SDK can be replaced."""
    from rlightning_aio.plugins.piper import arm, sim

    class TimedArm(arm.SimulatedArm):
        """Has its own clock, and records its travel."""

        def __init__(self) -> None:
            super().__init__()
            self.clock = 0.0
            self.travelled = 0.0
            self.stopped_at: float | None = None
            self.moved = threading.Condition()

        def advance(self, seconds: float) -> None:
            with self.moved:
                before = self.joints
                super().advance(seconds)
                self.clock += seconds
                # Of the joint with the largest travel.
                self.travelled += float(np.degrees(np.abs(self.joints - before).max()))
                if self.is_stopped and self.stopped_at is None:
                    self.stopped_at = self.clock
                self.moved.notify_all()

        @property
        def is_stopped(self) -> bool:
            at_target = np.abs(self.targets - self.joints).max() == 0
            return bool(self.emergency_stopped or not any(self.enabled) or at_target)

        def wait_until(self, condition: Any) -> None:
            with self.moved:
                if not self.moved.wait_for(condition, PATIENCE):
                    raise TimeoutError(f"the arm is at {self.joints}, going to {self.targets}")

    return TimedArm, sim


@dataclass
class Stopped:
    """The outcome for one arm: seconds from the event to standstill, by the arm's clock, travel of
    its fastest joint in degrees, and after a stopped process was continued.
    """

    place: str
    event: str
    during: str
    seconds: float
    degrees: float
    moved_again: float


def measure(place: str, event: str, during: str = "step", speed: int = 10) -> list[Stopped]:
    """Let something happen and measure the travel of each arm."""
    timed_arm, sim = arms()
    with contextlib.ExitStack() as cleanup:
        ports = [sim.SlcanPort() for _ in STOPS]
        moving = [timed_arm() for _ in STOPS]
        for port, arm in zip(ports, moving, strict=True):
            cleanup.callback(port.close)
            cleanup.enter_context(sim.running(arm, port))
        trouble = Path(cleanup.enter_context(tempfile.TemporaryDirectory())) / "trouble"
        channels = [port.path for port in ports]
        targets = cleanup.enter_context(started(place, channels, during, speed, trouble))
        for arm in moving:
            arm.wait_until(lambda arm=arm: arm.travelled > 2)
            assert not arm.is_stopped
        before: list[tuple[float, float]] = []
        for arm in moving:
            with arm.moved:
                arm.stopped_at = None
                before.append((arm.clock, arm.travelled))
        if event in EVENTS:
            trouble.write_text(event)
        else:
            send(event, f"SIG{TERMINAL.get(event, event)}", targets)
        for arm in moving:
            arm.wait_until(lambda arm=arm: arm.stopped_at is not None)
        ends = [arm.travelled for arm in moving]
        if event in ("STOP", "Ctrl-Z"):
            send(event, "SIGCONT", targets)
            for arm in moving:
                arm.wait_until(lambda arm=arm: arm.clock > arm.stopped_at + 1.0)
        return [
            Stopped(place, event, during, arm.stopped_at - at, end - begin, arm.travelled - end)
            for arm, (at, begin), end in zip(moving, before, ends, strict=True)
        ]


def send(event: str, name: str, targets: list[int]) -> None:
    """Send a signal to processes; what a terminal sends goes to the groups that they lead."""
    for target in targets:
        os.kill(-target if event in TERMINAL else target, getattr(signal, name))


def children(pid: int) -> list[int]:  # Incomplete while processes come and go.
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text().split()]


def launched(
    place: str, entries: list[dict[str, Any]], during: str, start: Any, folder: Path
) -> tuple[list[Any], list[Any]]:
    """Start the processes that drive the arms. Return the trainers, and who gets the signal."""

    def command(name: str, one: dict[str, Any], *options: str) -> Any:
        config = folder / f"{one['name']}.yaml"
        config.write_text(json.dumps({"envs": [one]}))
        run = "from rlightning_aio.cli import main; main()"
        return start("-c", run, name, str(config), *options)

    if (name := place.removesuffix(" of workers")) in COMMANDS:
        return [], [command(name, one, *COMMANDS[name]) for one in entries]
    groups = [entries]
    if place == "inline":  # A reset moves one arm of a group after the other.
        groups = [[one] for one in entries]
    elif place in ("client", "server"):
        # Such a long heartbeat at the server that its clients alone find out.
        kwargs = {"clients": 3, "connect_timeout": 60, "heartbeat": 30 if place == "client" else 1}
        groups = [[{"name": "arms", "backend": "env_server", "env_kwargs": kwargs}]]
    trainers = [start(__file__, "--drive", during, json.dumps(group)) for group in groups]
    if place not in ("client", "server"):
        return trainers, trainers
    options = ["--connect", trainers[0].stdout.readline().strip(), "--name"]
    clients = [command("client", one, *options, one["name"]) for one in entries]
    return trainers, clients if place == "client" else trainers


@contextlib.contextmanager
def started(
    place: str, channels: list[str], during: str, speed: int, trouble: Path
) -> Iterator[list[int]]:
    """Have arms driven; yield the ids of the processes that get the signal."""
    own = {"CAN_CONFIG": '{"sleep_after_open": 0.0}', "ARM_STOPS_TROUBLE": str(trouble)}
    environment = {**os.environ, **own, "PYTHONPATH": str(Path(__file__).parent)}
    placement = "inline" if place in ("inline", *COMMANDS) else "process"
    entries = [entry(*pair, placement, during, speed) for pair in zip(STOPS, channels, strict=True)]
    processes: list[subprocess.Popen[str]] = []
    drained: list[threading.Thread] = []

    def start(*command: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, *command],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            process_group=0,  # In this session: Ctrl-Z does nothing to a group without a shell.
            # The parent may ignore some of these signals, as nohup does.
            preexec_fn=_default_signals,  # noqa: PLW1509  # Sets signals only.
        )
        processes.append(process)
        return process

    try:
        trainers, targets = launched(place, entries, during, start, trouble.parent)
        if any(trainer.stdout.readline() != "moving\n" for trainer in trainers):
            raise RuntimeError(f"the trainer of {place} did not come to move its arms")
        found = [target.pid for target in targets]
        while place == "worker" and len(found) != len(STOPS):
            forked = [one for server in children(trainers[0].pid) for one in children(server)]
            found = [one for one in forked if children(one)]
        pipes = [pipe for process in processes for pipe in (process.stdout, process.stderr)]
        drained += [threading.Thread(target=pipe.read, daemon=True) for pipe in pipes]
        for thread in drained:
            thread.start()
        yield found
    finally:
        for process in processes:
            process.kill()
            process.wait()
        # Their workers and watchdogs hold pipes, too. One that outlives its port would stop the
        # next arm with that path.
        for thread in drained:
            thread.join()
        for process in processes:
            process.stdin.close()
            process.stdout.close()
            process.stderr.close()


def table(found: list[Stopped]) -> str:
    """Return a Markdown table with the travel of each arm after the event, by its kind of stop."""
    lines = ["| where | event | during a | `hold` | `emergency_stop` | `disable` |"]
    lines.append("|---|---|---|---|---|---|")
    for first in range(0, len(found), len(STOPS)):
        arms = found[first : first + len(STOPS)]
        ways = [f"{one.degrees:.1f}° in {one.seconds:.2f} s" for one in arms]
        lines.append(f"| {' | '.join((arms[0].place, arms[0].event, arms[0].during, *ways))} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--events", nargs="+", choices=(*SIGNALS, *TERMINAL, *EVENTS))
    parser.add_argument("--places", nargs="+", choices=sorted({place for place, *_ in ROWS}))
    parser.add_argument("--during", nargs="+", choices=DURING)
    parser.add_argument("--speed", type=int, default=10, help="percent: 10 is 17 degrees a second")
    parser.add_argument("--drive", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.drive:
        drive(json.loads(given.drive[1]), given.drive[0])
        return
    found: list[Stopped] = []
    for row in ROWS:
        wanted = zip((given.places, given.events, given.during), row, strict=True)
        if all(one in (chosen or [one]) for chosen, one in wanted):
            found += measure(*row, given.speed)
            print(table(found[-len(STOPS) :]).splitlines()[-1], file=sys.stderr, flush=True)
    print(table(found))


if __name__ == "__main__":
    main()
