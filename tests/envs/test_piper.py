"""The Piper backend: the vendor's unmodified SDK against a simulated arm on a real channel."""

from __future__ import annotations

import math
import os
import signal
import struct
import subprocess
import sys
import threading
from typing import TYPE_CHECKING, Any
from unittest import mock

import numpy as np
import pytest
from patience import HANG

from rlightning_aio.config import EnvConfig
from rlightning_aio.errors import BadAction, ConfigError
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

pytest.importorskip("piper_sdk")
pytest.importorskip("serial")

from envs.watched_arm import WatchedArm

from rlightning_aio.plugins.piper.arm import CanFrame
from rlightning_aio.plugins.piper.cameras import Cameras
from rlightning_aio.plugins.piper.env import PiperEnv
from rlightning_aio.plugins.piper.sim import SlcanPort, running

pytestmark = [
    pytest.mark.simulators,
    # The SDK uses the former name of an argument of python-can.
    pytest.mark.filterwarnings("ignore:.*bustype.*:DeprecationWarning"),
]

READY = [0.0, 0.5, -0.5, 0.0, 0.0, 0.0]
STOP_COMMAND = CanFrame(0x150, bytes([1, 0, 0, 0, 0, 0, 0, 0]))


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> Iterator[SlcanPort]:
    # Real adapters restart when their port is opened; a terminal doesn't.
    monkeypatch.setenv("CAN_CONFIG", '{"sleep_after_open": 0.0}')
    port = SlcanPort()
    yield port
    port.close()


@pytest.fixture
def arm(port: SlcanPort) -> Iterator[WatchedArm]:
    arm = WatchedArm()
    with running(arm, port):
        yield arm


def impatient(env: PiperEnv) -> Any:
    """For a while, wait for feedback no longer than 0.6 s; an arm that answers gets more time."""
    short = env._options.model_copy(update={"feedback_timeout": 0.6})
    return mock.patch.object(env, "_options", short)


@pytest.fixture
def make(port: SlcanPort) -> Iterator[Callable[..., PiperEnv]]:
    """Builds envs on the test's port. Requested after the arm, so that envs are closed first."""
    made: list[PiperEnv] = []

    def build(num_workers: int = 1, max_episode_steps: int | None = None, **env_kwargs: Any):
        env_kwargs = {
            "can_interface": "slcan",
            "channel": port.path,
            "control_hz": 50,
            "speed": 100,
            "reset_joints": READY,
            # The machine may be busy.
            "feedback_timeout": 5.0,
            "watchdog_timeout": 5.0,
            **env_kwargs,
        }
        config = EnvConfig(
            name="arm",
            backend="piper",
            task="test",
            num_workers=num_workers,
            max_episode_steps=max_episode_steps,
            env_kwargs=env_kwargs,
        )
        made.append(PiperEnv(config))
        return made[-1]

    yield build
    for env in made:
        env.close()


def respond(action: Any) -> PolicyResponse:
    return PolicyResponse("arm-0", action=action)


def sent_joints(commands: list[CanFrame]) -> list[list[int]]:
    """All complete sets of joint targets, in 0.001 degrees."""
    halves = [f for f in commands if f.can_id in (0x155, 0x156, 0x157)]
    sets = zip(halves[::3], halves[1::3], halves[2::3], strict=False)
    return [[n for f in three for n in struct.unpack(">ii", f.data)] for three in sets]


def in_si_units(pose: list[float]) -> list[float]:
    """A pose in m and rad, of one in mm and degrees."""
    return [*(value / 1000 for value in pose[:3]), *np.radians(pose[3:]).tolist()]


def test_a_reset_goes_to_the_configured_position(arm: WatchedArm, make: Any) -> None:
    """After a reset the motors are on and each joint is at its position."""
    env = make(reset_gripper=0.05)
    assert arm.enabled == [False] * 6
    ret = env.reset(seed=0)
    assert all(arm.enabled)
    assert ret.observation["joint_positions"] == pytest.approx(READY, abs=0.021)
    assert env.get_observation_space().contains(ret.observation)
    assert ret.info == {"arm_status": "NORMAL", "late": 0.0}


def test_joint_targets_are_sent_in_thousandths_of_degrees(arm: WatchedArm, make: Any) -> None:
    """An action in rad and m is sent in the units of the protocol, at the set speed."""
    env = make(speed=40)
    env.reset()
    arm.commands.clear()
    env.step(respond([0.1, 0.6, -0.7, 0.2, -0.3, 1.0, 0.0335]))
    assert sent_joints(arm.commands) == [[5730, 34377, -40107, 11459, -17189, 57296]]
    assert CanFrame(0x151, bytes([1, 1, 40, 0, 0, 0, 0, 0])) in arm.commands
    assert CanFrame(0x159, struct.pack(">iHBB", 33500, 1000, 1, 0)) in arm.commands


def test_steps_take_the_arm_to_the_target(arm: WatchedArm, make: Any) -> None:
    """Repeating an action takes the arm to its target, by the arm's feedback."""
    env = make()
    env.reset()
    target = np.array([0.4, 0.8, -0.9, 0.3, -0.2, 0.5, 0.02], np.float32)
    for _ in range(60):
        ret = env.step(respond(target))
        assert env.get_observation_space().contains(ret.observation)
    assert ret.observation["joint_positions"] == pytest.approx(target[:6], abs=1e-4)
    assert ret.observation["gripper"] == pytest.approx(target[6:], abs=1e-4)
    expected = arm.end_pose(target[:6].tolist())
    assert ret.observation["end_pose"][:3] * 1000 == pytest.approx(expected[:3], abs=0.1)
    assert np.degrees(ret.observation["end_pose"][3:]) == pytest.approx(expected[3:], abs=0.1)
    assert (ret.last_reward, ret.last_terminated, ret.last_truncated) == (0.0, False, False)


def test_an_observation_is_newer_than_its_action(arm: WatchedArm, make: Any) -> None:
    """Even at a control rate above the feedback rate."""
    env = make(control_hz=200)
    env.reset()
    before = env.step(respond([*READY, 0.0])).observation["joint_positions"][0]
    for turn in range(1, 6):
        ret = env.step(respond([0.5 * turn, *READY[1:], 0.0]))
        assert ret.observation["joint_positions"][0] > before
        before = ret.observation["joint_positions"][0]


def test_end_poses_are_reached_or_reported(arm: WatchedArm, make: Any) -> None:
    """A pose is reached in m and rad; one without a solution moves nothing and is not an error."""
    env = make(control="end_pose", gripper=False)
    env.reset()
    action = in_si_units(arm.end_pose([0.2, 0.7, -0.8, 0.1, 0.2, 0.1]))
    for _ in range(60):
        ret = env.step(respond(action))
    assert ret.observation["end_pose"] == pytest.approx(action, abs=2e-3)
    assert "gripper" not in ret.observation
    statuses = [
        env.step(respond([0.69, 0.0, 0.79, 0.0, 0.0, 0.0])).info["arm_status"] for _ in range(5)
    ]
    assert statuses[-1] == "NO_SOLUTION"  # It takes the simulated arm a while to find none.
    assert ret.observation["end_pose"] == pytest.approx(action, abs=2e-3)
    statuses = [env.step(respond(action)).info["arm_status"] for _ in range(5)]
    assert statuses[-1] == "NORMAL"


@pytest.mark.parametrize(
    ("control", "index", "value", "message"),
    [
        ("joint", 0, 2.7, r"arm-0: joint_1 = 2\.7 rad is outside \[-2\.6179, 2\.6179\]"),
        ("joint", 1, -0.01, r"joint_2 = -0\.01 rad is outside \[0, 3\.14\]"),
        ("joint", 4, math.nan, r"joint_5 = nan rad is outside"),
        ("joint", 5, math.inf, r"joint_6 = inf rad is outside"),
        ("joint", 6, 0.08, r"gripper = 0\.08 m is outside \[0, 0\.07\]"),
        ("end_pose", 2, -0.1, r"z = -0\.1 m is outside \[0, 0\.8\]"),
    ],
)
def test_a_number_outside_its_limits_is_never_sent(
    arm: WatchedArm, make: Any, control: str, index: int, value: float, message: str
) -> None:
    """The error names the number, its value and its limits; the arm holds its position."""
    env = make(control=control)
    env.reset()
    action = [*READY, 0.0] if control == "joint" else [*in_si_units(arm.end_pose(READY)), 0.0]
    env.step(respond(action))
    arm.commands.clear()
    action[index] = value
    with pytest.raises(BadAction, match=message):
        env.step(respond(action))
    assert arm.wait_for(lambda: sent_joints(arm.commands))
    # Only the safe stop was sent: hold the position.
    assert {frame.can_id for frame in arm.commands} <= {0x151, 0x155, 0x156, 0x157, 0x159}
    held = np.radians(np.array(sent_joints(arm.commands)[-1]) / 1000)
    assert held == pytest.approx(arm.joints, abs=1e-4)


def test_the_action_space_is_the_limits(arm: WatchedArm, make: Any) -> None:
    """Each element of the space is accepted, including corners; limits can be narrowed."""
    env = make(limits={"joint_1": [-0.5, 0.5], "gripper": [0.0, 0.03]})
    space = env.get_action_space()
    assert space.low[0] == -0.5
    assert space.high[6] == pytest.approx(0.03)
    env.reset()
    env.step(respond(space.low))
    env.step(respond(space.high))
    with pytest.raises(BadAction, match=r"joint_1 = 0\.6 rad is outside \[-0\.5, 0\.5\]"):
        env.step(respond([0.6, *space.low[1:]]))


STOPS = {
    "hold": lambda arm: sent_joints(arm.commands) and not arm.emergency_stopped,
    "emergency_stop": lambda arm: arm.emergency_stopped,
    "disable": lambda arm: not any(arm.enabled),
}


@pytest.mark.parametrize("safe_stop", STOPS)
@pytest.mark.parametrize("cause", ["exception", "interrupt", "close", "on_disconnect"])
def test_errors_and_ends_make_the_safe_stop(
    arm: WatchedArm, make: Any, safe_stop: str, cause: str
) -> None:
    """An exception in a step, a close and a lost trainer each stop the arm as configured."""
    env = make(safe_stop=safe_stop, speed=20)
    env.reset()
    far = [1.5, 2.0, -2.0, 1.0, 1.0, 1.0, 0.0]
    env.step(respond(far))
    assert np.abs(arm.joints - arm.targets).max() > 0.5
    arm.commands.clear()
    if cause in ("exception", "interrupt"):
        error = ZeroDivisionError if cause == "exception" else KeyboardInterrupt

        def fail(policy_resp: PolicyResponse) -> Any:
            raise error

        env._preprocess_fn = fail
        with pytest.raises(error):
            env.step(respond(far))
    else:
        getattr(env, cause)()
    assert arm.wait_for(lambda: STOPS[safe_stop](arm))
    if safe_stop == "hold":
        assert arm.wait_for(lambda: np.abs(arm.joints - arm.targets).max() < 0.05)
        assert all(arm.enabled)


def test_a_hold_holds_the_gripper(arm: WatchedArm, make: Any) -> None:
    """At an exception while it opens to 69 mm, it stays at its opening."""
    env = make()
    env.reset()
    while arm.gripper < 0.004:
        env.step(respond([*READY, 0.069]))
    env._preprocess_fn = lambda policy_resp: 1 / 0
    with pytest.raises(ZeroDivisionError):
        env.step(respond([*READY, 0.069]))
    assert arm.gripper_target < 0.06
    assert arm.wait_for(lambda: abs(arm.gripper_target - arm.gripper) < 1e-4)


def test_a_reset_waits_for_the_gripper(arm: WatchedArm, make: Any) -> None:
    """It is at its position when the reset returns, or the error has its position."""
    env = make(reset_gripper=0.06, move_timeout=5.0)
    ret = env.reset()
    assert ret.observation["gripper"] == pytest.approx([0.06], abs=2.1e-3)
    env.close()
    arm.in_the_grip = 0.03
    env = make(reset_gripper=0.0, move_timeout=1.0)
    with pytest.raises(TimeoutError, match=r"the gripper is at 0\.030 m, not 0\.000"):
        env.reset()


def test_the_pose_that_the_arm_reports_is_an_action(arm: WatchedArm, make: Any) -> None:
    """If the hand points down, rx is half a turn; slightly more is accepted."""
    env = make(control="end_pose", reset_joints=[0.0, 1.2, -1.0, 0.0, 1.1, 0.0])
    ret = env.reset()
    pose = ret.observation["end_pose"]
    assert abs(pose[3]) == pytest.approx(math.pi, abs=1e-3)
    for delta in (0.01, -0.02, 0.01):
        pose = pose + np.array([0.0, 0.0, 0.001, delta, 0.0, 0.0], np.float32)
        env.step(respond([*pose, 0.0]))
    assert {struct.unpack(">ii", f.data)[1] for f in arm.commands if f.can_id == 0x153}


@pytest.mark.parametrize("fault", [signal.SIGKILL, signal.SIGSTOP])
def test_a_watchdog_that_is_lost_is_replaced_by_one_that_stops_the_arm(
    arm: WatchedArm, make: Any, fault: signal.Signals
) -> None:
    """If it is killed or suspended, the env loses the bus, but the arm is stopped."""
    env = make(safe_stop="emergency_stop")
    env.reset()
    env.step(respond([*READY, 0.0]))
    env._link._process.send_signal(fault)

    def go_on() -> None:
        for _ in range(100):
            env.step(respond([*READY, 0.0]))

    with impatient(env), pytest.raises(ConnectionError, match="no feedback from the arm"):
        go_on()
    assert arm.wait_for(lambda: arm.emergency_stopped)
    assert env.reset(options={"resume": True}).info["arm_status"] == "NORMAL"
    assert env.step(respond([*READY, 0.0])).info["arm_status"] == "NORMAL"


@pytest.mark.parametrize("fault", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("was_reset", [False, True])
def test_a_reset_replaces_a_lost_watchdog_of_a_stopped_arm(
    arm: WatchedArm, make: Any, fault: signal.Signals, was_reset: bool
) -> None:
    """Without an emergency stop of an arm that was never switched on."""
    env = make(safe_stop="emergency_stop" if not was_reset else "hold")
    if was_reset:
        env.reset()
        env.on_disconnect()
    env._link._process.send_signal(fault)
    assert env.reset().info["arm_status"] == "NORMAL"
    assert env.step(respond([*READY, 0.0])).info["arm_status"] == "NORMAL"


def test_a_reset_opens_a_bus_that_is_back(
    monkeypatch: pytest.MonkeyPatch, make: Any, tmp_path: Path
) -> None:
    """An adapter is unplugged and plugged in again; in between the reset raises."""
    monkeypatch.setenv("CAN_CONFIG", '{"sleep_after_open": 0.0}')
    channel = tmp_path / ("adapter" * 20)  # A name as long as an address of a socket can't be.
    port = SlcanPort()
    channel.symlink_to(port.path)
    with running(WatchedArm(), port):
        env = make(channel=str(channel))
        env.reset()
    port.close()
    channel.unlink()
    with pytest.raises(ConnectionError, match="no feedback from the arm"):
        env.step(respond([*READY, 0.0]))
    with pytest.raises(ConnectionError, match="can't be opened; is it there"):
        env.reset()
    port = SlcanPort()
    channel.symlink_to(port.path)
    with running(WatchedArm(), port):
        assert env.reset().info["arm_status"] == "NORMAL"
        env.close()
    port.close()


def test_missing_heartbeats_stop_the_arm(arm: WatchedArm, make: Any) -> None:
    """The next step raises with the cause; a reset starts the arm again."""
    env = make(watchdog_timeout=1.0)
    env.reset()
    period, env._link._period = env._link._period, 1000.0  # As if this process were suspended.
    assert env._link.wait_until(lambda: env._link.stopped_because, HANG)
    with pytest.raises(RuntimeError, match="watchdog stopped it: it gave no sign of life for 1 s"):
        env.step(respond([*READY, 0.0]))
    env._link._period = period
    env.reset()
    env.step(respond([*READY, 0.0]))


def test_a_stopped_arm_moves_again_only_after_a_reset(arm: WatchedArm, make: Any) -> None:
    """Steps before the first reset, and after a safe stop, raise and send nothing."""
    env = make()
    with pytest.raises(RuntimeError, match=r"arm-0: the arm is stopped; reset\(\)"):
        env.step(respond([*READY, 0.0]))
    assert sent_joints(arm.commands) == []
    env.reset()
    env.on_disconnect()
    with pytest.raises(RuntimeError, match="stopped"):
        env.step(respond([*READY, 0.0]))
    env.reset()
    env.step(respond([*READY, 0.0]))


def test_an_emergency_stop_is_ended_only_on_request(arm: WatchedArm, make: Any) -> None:
    """A reset without the option raises, and says how to end the stop."""
    env = make()
    env.reset()
    arm.emergency_stopped = True
    with pytest.raises(RuntimeError, match="arm-0: the arm reports EMERGENCY_STOP"):
        env.step(respond([*READY, 0.0]))
    with pytest.raises(RuntimeError, match=r"under emergency stop.*\"resume\": True"):
        env.reset()
    assert arm.emergency_stopped
    env.reset(options={"resume": True})
    assert not arm.emergency_stopped
    env.step(respond([*READY, 0.0]))


def test_lost_feedback_is_an_error_and_an_emergency_stop(arm: WatchedArm, make: Any) -> None:
    """Without feedback the position for a hold is unknown."""
    env = make()
    env.reset()
    arm.silent = True
    lost = r"no feedback from the arm .* for 0\.6 s.*0x2A5"
    with impatient(env), pytest.raises(ConnectionError, match=lost):
        env.step(respond([*READY, 0.0]))
    assert arm.wait_for(lambda: STOP_COMMAND in arm.commands)


def test_a_silent_arm_is_a_clear_error(make: Any, port: SlcanPort) -> None:
    """Building the env fails in time, and releases the channel."""
    message = r"no feedback from the arm on slcan channel.*0\.2 s.*is it powered"
    for _ in range(2):
        with pytest.raises(ConnectionError, match=message):
            make(connect_timeout=0.2)


def test_a_missing_channel_is_a_clear_error(arm: WatchedArm, make: Any) -> None:
    """The message has the channel, and for SocketCAN the command that brings it up."""
    with pytest.raises(ConnectionError, match="slcan channel '/dev/nothing' can't be opened"):
        make(channel="/dev/nothing")
    with pytest.raises(ConnectionError, match=r"socketcan channel 'can9'.*ip link set can9 up"):
        make(can_interface="socketcan", channel="can9")


def test_motors_that_stay_off_end_the_reset(arm: WatchedArm, make: Any) -> None:
    """After the time limit, with the status of the arm."""
    env = make(connect_timeout=0.5)
    arm.deaf_to.add(0x471)
    with pytest.raises(TimeoutError, match=r"motors .* not enabled after 0\.5 s.*NORMAL"):
        env.reset()


def test_a_position_that_is_not_reached_ends_the_reset(arm: WatchedArm, make: Any) -> None:
    """The error names the joint that is furthest off, and the arm is stopped."""
    env = make(move_timeout=0.5, safe_stop="emergency_stop")
    arm.deaf_to.add(0x156)
    with pytest.raises(TimeoutError, match=r"joint_3 is at 0\.000 rad, not -0\.500"):
        env.reset()
    assert arm.wait_for(lambda: arm.emergency_stopped)


def test_commands_that_the_bus_loses_are_repeated(arm: WatchedArm, make: Any) -> None:
    """A reset whose first targets are lost still arrives."""
    env = make()
    arm.deaf_to.update({0x155, 0x156, 0x157})
    lost = threading.Thread(
        target=lambda: arm.wait_for(lambda: sent_joints(arm.commands)) and arm.deaf_to.clear()
    )
    lost.start()
    ret = env.reset()
    lost.join()
    assert ret.observation["joint_positions"] == pytest.approx(READY, abs=0.021)


def test_one_channel_has_one_env(arm: WatchedArm, make: Any, port: SlcanPort) -> None:
    """A second env on the channel raises, until the first is closed."""
    env = make()
    with pytest.raises(ConfigError, match=r"channel: .* is in use by another env of this process"):
        make()
    with pytest.raises(ConfigError, match="2 channels for 3 envs"):
        make(num_workers=3, channel=["can0", "can1"])
    env.close()
    env.close()
    env = make(num_workers=1, channel=[port.path])
    assert env.reset().info["arm_status"] == "NORMAL"


HOLDER = """
import sys
from rlightning_aio.config import EnvConfig
from rlightning_aio.plugins.piper.env import PiperEnv
env_kwargs = {"can_interface": "slcan", "channel": sys.argv[1], "connect_timeout": 30}
try:
    env = PiperEnv(EnvConfig(name="other", backend="piper", task="t", env_kwargs=env_kwargs))
except Exception as error:
    print(error, flush=True)
else:
    print("built", flush=True)
    sys.stdin.read()
"""


def test_one_channel_has_one_env_in_all_processes(
    arm: WatchedArm, make: Any, port: SlcanPort
) -> None:
    """Two programs can't drive one arm; a killed program releases the channel."""

    def other() -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-W", "ignore", "-c", HOLDER, port.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    env = make()
    with other() as refused:
        said, _ = refused.communicate(timeout=HANG)
    assert f"is in use by process {os.getpid()}; an arm has one env" in said
    env.close()
    with other() as holder:
        assert holder.stdout
        assert holder.stdout.readline() == "built\n"
        with pytest.raises(ConfigError, match=f"is in use by process {holder.pid}"):
            make()
        holder.kill()
        holder.wait()
        assert make().reset().info["arm_status"] == "NORMAL"


def read_images() -> dict[str, np.ndarray]:
    return {"wrist": np.full((4, 6, 3), 7, np.uint8)}


def reward(observation: dict[str, Any], action: np.ndarray) -> float:
    return float(-abs(observation["joint_positions"][0] - action[0]))


def test_cameras_and_reward_come_from_hooks(arm: WatchedArm, make: Any) -> None:
    """Images join the observation under their declared spaces; the reward is the hook's."""
    env = make(
        cameras={"read": f"{__name__}:read_images", "images": {"wrist": [4, 6, 3]}},
        reward=f"{__name__}:reward",
    )
    assert env.get_observation_space()["wrist"].shape == (4, 6, 3)
    ret = env.reset()
    assert env.get_observation_space().contains(ret.observation)
    ret = env.step(respond([1.0, *READY[1:], 0.0]))
    assert ret.observation["wrist"][0, 0, 0] == 7
    assert ret.last_reward == pytest.approx(ret.observation["joint_positions"][0] - 1.0)


_hang = threading.Event()


def read_late() -> dict[str, np.ndarray]:
    _hang.wait(HANG)
    return read_images()


def test_a_camera_that_hangs_stops_the_arm_after_its_time_limit(arm: WatchedArm, make: Any) -> None:
    """And later pictures of that call are not taken for those of another one."""
    env = make(
        cameras={"read": f"{__name__}:read_late", "images": {"wrist": [4, 6, 3]}},
        camera_timeout=0.3,
        safe_stop="emergency_stop",
    )
    _hang.set()
    env.reset()
    _hang.clear()
    with pytest.raises(TimeoutError, match=r"no images within 0\.3 s \(camera_timeout\)"):
        env.step(respond([1.0, *READY[1:], 0.0]))
    assert arm.emergency_stopped
    _hang.set()
    assert env.reset(options={"resume": True}).observation["wrist"][0, 0, 0] == 7


def test_a_picture_of_a_call_that_was_interrupted_is_not_that_of_the_next() -> None:
    """Whenever Ctrl-C came: each picture would be one too old from then on."""
    numbers = iter(range(9))
    cameras = Cameras(lambda: {"wrist": next(numbers)}, HANG)
    asked = cameras._asked

    def struck(number: int) -> None:
        asked.put(number)
        raise KeyboardInterrupt

    cameras._asked = mock.Mock(get=asked.get, put=struck)
    with pytest.raises(KeyboardInterrupt):
        cameras.read()
    cameras._asked = asked
    assert cameras.read() == {"wrist": 1}
    cameras.close()


def test_an_arm_can_be_stopped_on_its_way_to_the_reset_position(arm: WatchedArm, make: Any) -> None:
    """From another thread; the reset raises, and the next one moves the arm again."""
    env = make(reset_joints=[2.0, *READY[1:]], speed=20)
    stopper = threading.Thread(
        target=lambda: (arm.wait_for(lambda: arm.joints[0] > 0.1), env.stop()), daemon=True
    )
    stopper.start()
    with pytest.raises(RuntimeError, match=r"the env's stop\(\) was called; reset\(\) starts"):
        env.reset()
    stopper.join()
    assert arm.joints[0] < 1.0
    assert env.reset().observation["joint_positions"][0] == pytest.approx(2.0, abs=0.021)


@pytest.mark.parametrize(
    ("env_kwargs", "message"),
    [
        ({"chanel": "can0"}, r"arm-0: env_kwargs\.chanel: unknown field; did you mean 'channel'"),
        ({"control_hz": 0}, r"env_kwargs\.control_hz: .*greater than 0"),
        ({"limits": {"joint_7": [0, 1]}}, r"limits\.joint_7: an action .* has joint_1"),
        ({"limits": {"joint_1": [-3, 3]}}, r"limits\.joint_1: .* not within the arm's own"),
        ({"reward": "nowhere:at_all"}, r"env_kwargs\.reward: 'nowhere:at_all' can't be loaded"),
    ],
)
def test_errors_of_the_config_are_named(
    arm: WatchedArm, make: Any, env_kwargs: dict[str, Any], message: str
) -> None:
    """Before the channel is opened."""
    with pytest.raises(ConfigError, match=message):
        make(**env_kwargs)


def test_the_arm_can_be_in_another_process(make: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """`python -m rlightning_aio.plugins.piper.sim` prints a channel and ends at a signal."""
    command = [sys.executable, "-m", "rlightning_aio.plugins.piper.sim", "--feedback-hz", "50"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        channel = process.stdout.readline().strip()
        env = make(channel=channel)
        assert env.reset().observation["joint_positions"] == pytest.approx(READY, abs=0.021)
        env.close()
        process.send_signal(signal.SIGTERM)
        assert process.wait(HANG) == 0
