"""The guard's filter and stops, frame by frame, without a bus or a clock; and a bus that fails."""

from __future__ import annotations

import socket
import struct
from typing import Any
from unittest import mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio.plugins.piper import watchdog
from rlightning_aio.plugins.piper.guard import ArmGuard, CanFrame
from rlightning_aio.plugins.piper.watchdog import Kind

ANY_COMMAND = CanFrame(0x155, struct.pack(">ii", 1000, 2000))
EMERGENCY_STOP = CanFrame(0x150, bytes([1, 0, 0, 0, 0, 0, 0, 0]))
MOTORS_OFF = CanFrame(0x471, bytes([7, 1, 0, 0, 0, 0, 0, 0]))
AT_REST = (1000, 30_000, -30_000, 4000, -5000, 6000)
"""Joints, in 0.001 degrees."""


def guard(stop: Any = "hold", *, gripper: bool = False) -> ArmGuard:
    made = ArmGuard(stop, 0.5, 40, 1500 if gripper else None)
    made.arm(0.0)
    return made


def report(made: ArmGuard, now: float, joints: Any = AT_REST, gripper: int = 0) -> None:
    for k in range(3):
        made.heard(CanFrame(0x2A5 + k, struct.pack(">ii", *joints[2 * k : 2 * k + 2])), now)
    made.heard(CanFrame(0x2A8, struct.pack(">ihBB", gripper, 0, 0x40, 0)), now)


def grip(made: ArmGuard, opening: int, now: float) -> None:
    made.passes(CanFrame(0x159, struct.pack(">iHBB", opening, 1500, 1, 0)), now)


def grips(frames: list[CanFrame]) -> list[tuple[int, ...]]:
    return [struct.unpack(">iHBB", f.data) for f in frames if f.can_id == 0x159]


def targets(frames: list[CanFrame]) -> list[int]:
    halves = [f.data for f in frames if f.can_id in (0x155, 0x156, 0x157)]
    return [n for data in halves for n in struct.unpack(">ii", data)]


def stopped(made: ArmGuard, now: float, **reported: Any) -> list[CanFrame]:
    """All frames sent after the stop has begun, while the arm reports."""
    made.stop("a test", now)
    frames: list[CanFrame] = []
    for turn in range(100):
        if reported:
            report(made, now + turn * 0.01, **reported)
        frames += made.act(now + turn * 0.01)
        if not made.stopping:
            break
    return frames


@given(st.lists(st.sampled_from(["arm", "stop", "beat", "silence"]), max_size=20))
def test_commands_pass_only_between_arming_and_the_next_stop(acts: list[str]) -> None:
    """In any order of events, a stopped arm gets no commands of the program."""
    made, now, armed = ArmGuard("emergency_stop", 0.5, 40, None), 0.0, False
    for act in acts:
        now += 0.6 if act == "silence" else 0.1
        if act == "arm":
            made.arm(now)
            armed = True
        elif act == "stop":
            made.stop("", now)
            armed = False
        elif act == "beat":
            made.beat(now)
        else:
            armed = False
        made.act(now)
        if act != "beat":  # A late heartbeat doesn't count.
            assert made.passes(ANY_COMMAND, now) == armed
        armed = made.armed


def test_missing_heartbeats_stop_the_arm() -> None:
    """At the timeout and no earlier, with the cause."""
    made = guard("emergency_stop")
    made.beat(10.0)
    assert made.act(10.5) == []
    assert made.wait(10.4) == pytest.approx(0.1)
    assert made.act(10.51) == [EMERGENCY_STOP]
    assert made.cause == "it gave no sign of life for 0.5 s"


def test_a_stop_is_sent_three_times() -> None:
    """Because a bus may lose frames; frames that it rejects don't count."""
    assert stopped(guard("emergency_stop"), 1.0) == [EMERGENCY_STOP] * 3
    assert stopped(guard("disable"), 1.0) == [MOTORS_OFF] * 3
    made = guard("emergency_stop")
    made.stop("a test", 1.0)
    for turn in range(10):
        assert made.act(1.0 + turn) == [EMERGENCY_STOP]
        made.not_sent()
    assert made.stopping


def test_a_hold_is_repeated_at_the_latest_position() -> None:
    """The first hold uses the latest feedback, the others feedback since the stop."""
    made = guard()
    report(made, 1.0)
    made.stop("a test", 1.01)
    first = made.act(1.01)
    assert targets(first) == list(AT_REST)
    assert CanFrame(0x151, bytes([1, 1, 40, 0, 0, 0, 0, 0])) in first
    later = (1100, *AT_REST[1:])
    report(made, 1.02, later)
    assert made.act(1.02) == []
    assert targets(made.act(1.035)) == list(later)
    assert made.stopping


def test_a_hold_stays_within_the_limits() -> None:
    """A joint beyond its limits would refuse the target and continue to its last one."""
    low = targets(stopped(guard(), 1.0, joints=(0, -300, 200, 0, 0, 0)))
    assert set(low) == {0}
    far = targets(stopped(guard(), 1.0, joints=(151_000, 0, 0, 0, 0, -121_000)))
    assert (far[0], far[5]) == (149_994, -119_999)


def test_without_feedback_a_hold_is_an_emergency_stop() -> None:
    """The position is unknown, and old feedback doesn't count."""
    made = guard()
    report(made, 0.5)
    frames = stopped(made, 1.0)
    assert frames == [EMERGENCY_STOP] * 3


def test_a_moving_gripper_is_held_at_its_opening() -> None:
    """It stops at the opening that it reports."""
    made = guard(gripper=True)
    report(made, 0.9, gripper=2000)
    grip(made, 69_000, 0.95)
    report(made, 1.0, gripper=4000)
    held = grips(stopped(made, 1.0, gripper=4100))
    assert held[-1] == (4100, 1500, 1, 0)
    assert {opening for opening, *_ in held} <= {4000, 4100}


def test_a_gripper_that_is_about_to_close_is_held_open() -> None:
    """It has not moved yet, so standing still doesn't mean that it grips an object."""
    made = guard(gripper=True)
    grip(made, 40_000, 0.0)
    for now in (0.0, 0.5, 0.99):
        report(made, now, gripper=40_000)
    grip(made, 0, 0.99)
    assert grips(stopped(made, 1.0, gripper=40_000))[-1] == (40_000, 1500, 1, 0)


def test_a_gripped_object_stays_gripped() -> None:
    """Holding the opening would release it, so a pressing gripper gets no command."""
    made = guard(gripper=True)
    for now, opening in ((0.0, 40_000), (0.2, 30_000), (0.4, 30_000), (0.8, 30_050)):
        grip(made, round(1000 * now), now)  # Targets of a policy vary slightly.
        report(made, now, gripper=opening)
    frames = stopped(made, 1.0, gripper=30_000)
    assert targets(frames)
    assert grips(frames) == []


def test_a_hard_stop_includes_the_gripper() -> None:
    """It is switched off with the motors, and held by an emergency stop."""
    made = guard("disable", gripper=True)
    report(made, 1.0, gripper=5000)
    assert grips(stopped(made, 1.0)) == [(5000, 0, 0, 0)] * 3
    made = guard("emergency_stop", gripper=True)
    report(made, 1.0, gripper=5000)
    grip(made, 69_000, 1.0)
    frames = stopped(made, 1.0)
    assert grips(frames)[-1] == (5000, 1500, 1, 0)
    assert EMERGENCY_STOP in frames


@pytest.mark.parametrize("takes", [True, False])
def test_a_watchdog_says_whether_the_arm_has_stopped(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], takes: bool
) -> None:
    """On stderr, to whoever stands beside it; a program that is there learns of the fault."""
    monkeypatch.setattr(watchdog, "_GIVE_UP", 0.1)
    orders = {"stop": "disable", "timeout": 0.1, "speed": 50, "gripper_effort": None, "armed": True}
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    silent, other = socket.socketpair()
    with ours, silent, other:
        send = mock.Mock(side_effect=None if takes else OSError("bus off"))
        if takes:
            ours.close()
        watchdog.serve(theirs, mock.Mock(fileno=silent.fileno, send=send), orders)
        if not takes:
            assert [ours.recv(100) for _ in range(3)] == [Kind.OPEN, Kind.FAULT + b"bus off", b""]
    stopped, failed = "has stopped it: the program that drove it has ended", "could not stop it"
    said = capfd.readouterr().err
    assert (stopped in said, failed in said) == (takes, not takes)
