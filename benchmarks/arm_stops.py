"""How far does a robot arm travel after the process that drives it is killed or stopped?

    python benchmarks/arm_stops.py
    python benchmarks/arm_stops.py --signals HUP KILL --places client

Three simulated Piper arms, one for each kind of safe stop, are moving to a far target when one
process gets a signal: the trainer whose arms are in workers, the workers, a trainer whose arms are
inline, or the clients of another trainer. The arms listen on pseudo-terminals, and their own clocks
give the times of their stops. Needs ``rlightning-aio[piper]``.
"""

from __future__ import annotations

import argparse
import contextlib
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
import psutil

from rlightning_aio import BatchedData, PolicyResponse, sync
from rlightning_aio.errors import EnvFault

if TYPE_CHECKING:
    from collections.abc import Iterator

STOPS = ("hold", "emergency_stop", "disable")
SIGNALS = ("HUP", "INT", "TERM", "QUIT", "KILL", "STOP")
PLACES = ("trainer", "worker", "inline", "client")
FAR = [2.5, 3.0, -2.9, 1.7, 1.2, 2.0]
SPEED = 10
"""Percent; 17 degrees a second."""
PATIENCE = 60.0


def _default_signals() -> None:
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT):
        signal.signal(number, signal.SIG_DFL)


def options(stop: str, channel: str) -> dict[str, Any]:
    return {
        "can_interface": "slcan",
        "channel": channel,
        "speed": SPEED,
        "gripper": False,
        "safe_stop": stop,
        # Long, because the machine may be busy; the watchdog's time is what is measured.
        "feedback_timeout": 20.0,
        "connect_timeout": 60.0,
    }


def entry(stop: str, channel: str, placement: str) -> dict[str, Any]:
    return {
        "name": stop,
        "backend": "piper",
        "task": "stops",
        "placement": placement,
        "env_kwargs": options(stop, channel),
    }


def far(env_ids: list[str]) -> BatchedData[PolicyResponse]:
    return BatchedData(env_ids, [PolicyResponse(env_id, FAR) for env_id in env_ids])


def say(line: str) -> None:
    print(line, flush=True)


def drive(placement: str, channels: list[str]) -> None:
    """Run a trainer with an arm on each channel; print when they move, and the outcome."""
    entries = [entry(*pair, placement) for pair in zip(STOPS, channels, strict=True)]
    with sync.build_env_group(entries) as group:
        group.reset()
        try:
            while True:
                group.step(far(group.env_ids))
                say("moving")
        except EnvFault as fault:
            say(f"fault: {fault}")
            sys.stdin.read()


def serve() -> None:
    """Run a trainer whose arms are clients."""
    server = {"name": "arms", "backend": "env_server"}
    server["env_kwargs"] = {"clients": len(STOPS), "connect_timeout": PATIENCE, "heartbeat": 30}
    with sync.build_env_group(server) as group:
        say(group["arms-0"].address)
        batch, _ = group.reset()
        while True:
            try:
                group.step_async(far([value.env_id for value in batch.values()]))
                batch, _ = group.collect_async()
                say("moving")
            except EnvFault as fault:
                say(f"fault: {fault}")


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
    """The outcome for one arm.

    Attributes:
        signal, place, stop: the signal, the processes that got it, and the kind of safe stop.
        seconds: from the signal to standstill, by the arm's clock.
        degrees: travel of its fastest joint in that time.
        moved_again: travel in degrees after a stopped process was continued.
    """

    signal: str
    place: str
    stop: str
    seconds: float
    degrees: float
    moved_again: float


def measure(place: str, name: str) -> list[Stopped]:
    """Send one signal and measure the travel of each arm."""
    timed_arm, sim = arms()
    number = getattr(signal, f"SIG{name}")
    with contextlib.ExitStack() as cleanup:
        ports = [sim.SlcanPort() for _ in STOPS]
        moving = [timed_arm() for _ in STOPS]
        for port, arm in zip(ports, moving, strict=True):
            cleanup.callback(port.close)
            cleanup.enter_context(sim.running(arm, port))
        targets = cleanup.enter_context(started(place, [port.path for port in ports]))
        for arm in moving:
            arm.wait_until(lambda arm=arm: arm.travelled > 2)
            assert not arm.is_stopped
        before: list[tuple[float, float]] = []
        for arm in moving:
            with arm.moved:
                arm.stopped_at = None
                before.append((arm.clock, arm.travelled))
        for target in targets:
            target.send_signal(number)
        for arm in moving:
            arm.wait_until(lambda arm=arm: arm.stopped_at is not None)
        ends = [arm.travelled for arm in moving]
        if name == "STOP":
            for target in targets:
                target.send_signal(signal.SIGCONT)
            for arm in moving:
                arm.wait_until(lambda arm=arm: arm.clock > arm.stopped_at + 1.0)
        return [
            Stopped(
                name,
                place,
                stop,
                round(arm.stopped_at - clock, 3),
                round(end - travelled, 2),
                round(arm.travelled - end, 2),
            )
            for stop, arm, (clock, travelled), end in zip(STOPS, moving, before, ends, strict=True)
        ]


@contextlib.contextmanager
def started(place: str, channels: list[str]) -> Iterator[list[psutil.Process]]:
    """Start the processes that drive the arms; yield those that get the signal."""
    environment = {**os.environ, "CAN_CONFIG": '{"sleep_after_open": 0.0}'}
    with contextlib.ExitStack() as cleanup:

        def start(*command: str) -> subprocess.Popen[str]:
            process = subprocess.Popen(
                [sys.executable, *command],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                start_new_session=True,
                # The parent may ignore some of these signals, as nohup does.
                preexec_fn=_default_signals,  # noqa: PLW1509  # Sets signals only.
            )
            cleanup.callback(process.stdin.close)
            cleanup.callback(process.stdout.close)
            processes.append(process)
            return process

        processes: list[subprocess.Popen[str]] = []
        cleanup.callback(lambda: [process.wait() for process in processes])
        cleanup.callback(lambda: [process.kill() for process in processes])

        if place == "client":
            trainer = start(__file__, "--serve")
            address = trainer.stdout.readline().strip()
            folder = cleanup.enter_context(tempfile.TemporaryDirectory())
            clients: list[subprocess.Popen[str]] = []
            for stop, channel in zip(STOPS, channels, strict=True):
                config = Path(folder) / f"{stop}.yaml"
                config.write_text(json.dumps({"envs": [entry(stop, channel, "process")]}))
                run = "from rlightning_aio.cli import main; main()"
                arguments = ["client", str(config), "--connect", address, "--name", stop]
                clients.append(start("-c", run, *arguments))
            targets = [psutil.Process(client.pid) for client in clients]
        else:
            placement = "inline" if place == "inline" else "process"
            trainer = start(__file__, "--drive", placement, *channels)
            targets = [psutil.Process(trainer.pid)]
        if trainer.stdout.readline() != "moving\n":
            raise RuntimeError(f"the trainer of {place} did not come to move its arms")
        if place == "worker":
            targets = [w for fork_server in targets[0].children() for w in fork_server.children()]
        # Their further output must not fill a pipe.
        drained = [threading.Thread(target=p.stdout.read, daemon=True) for p in processes]
        for thread in drained:
            thread.start()
        yield targets
        for process in processes:
            process.kill()
        # Their workers hold the pipes, too. A worker that outlives its port would stop the next
        # arm with that path.
        for thread in drained:
            thread.join()


def table(found: list[Stopped]) -> str:
    """Return a Markdown table with the travel of each arm after the signal."""
    lines = [
        f"| signal | to | {' | '.join(f'`{stop}`' for stop in STOPS)} |",
        f"|---|---|{'---|' * len(STOPS)}",
    ]
    cells = {(one.signal, one.place, one.stop): one for one in found}
    for name, place in dict.fromkeys((one.signal, one.place) for one in found):
        row = [cells[name, place, stop] for stop in STOPS]
        ways = " | ".join(f"{one.degrees:.1f}° in {one.seconds:.2f} s" for one in row)
        lines.append(f"| SIG{name} | {TITLES[place]} | {ways} |")
    return "\n".join(lines)


TITLES = {
    "trainer": "trainer of workers",
    "worker": "worker",
    "inline": "trainer, `inline`",
    "client": "client",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--signals", nargs="+", choices=SIGNALS, default=SIGNALS)
    parser.add_argument("--places", nargs="+", choices=PLACES, default=PLACES)
    parser.add_argument("--drive", nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.drive:
        drive(arguments.drive[0], arguments.drive[1:])
    elif arguments.serve:
        serve()
    else:
        began = time.monotonic()
        found = [
            one
            for place in arguments.places
            for name in arguments.signals
            for one in measure(place, name)
        ]
        print(table(found))
        print(f"{len(found)} arms in {time.monotonic() - began:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
