"""HalfCheetahs over nodes in another network namespace, behind a slow link that loses packets.

    sudo python far_nodes.py --steps 20000 --delay-ms 5 --loss 0.001

The link is two TUN interfaces, one in each namespace, with this process in between. Trainer and
head live on one side, the actors on the other; each result is held against a local twin's, as in
`cheetahs.py`. Halfway through one of the two far nodes is killed. It needs root, and Linux.
"""

from __future__ import annotations

import argparse
import fcntl
import heapq
import os
import random
import select
import signal
import statistics
import struct
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

import ray_cluster

if TYPE_CHECKING:
    from collections.abc import Sequence

NEAR, FAR = "rl-near", "rl-far"
ADDRESSES = {NEAR: "10.77.0.1", FAR: "10.77.0.2"}
PORT = 6399
HALFWAY = "halfway\n"
TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000


def run(*command: str) -> None:
    subprocess.run(command, check=True)


def inside(namespace: str, *command: str) -> list[str]:
    return ["ip", "netns", "exec", namespace, *command]


def interface(namespace: str) -> int:
    """A TUN interface in a namespace, up; its descriptor."""
    name = f"{namespace}0"
    descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(descriptor, TUNSETIFF, struct.pack("16sH", name.encode(), IFF_TUN | IFF_NO_PI))
    run("ip", "link", "set", name, "netns", namespace)
    run(*inside(namespace, "ip", "address", "add", f"{ADDRESSES[namespace]}/24", "dev", name))
    run(*inside(namespace, "ip", "link", "set", name, "up"))
    run(*inside(namespace, "ip", "link", "set", "lo", "up"))
    return descriptor


def carry(ends: Sequence[int], delay: float, loss: float, stop: threading.Event) -> None:
    """Hand packets from either end to the other, late, but for those that are lost."""
    draw = random.Random(0)
    under_way: list[tuple[float, int, int, bytes]] = []
    count = 0
    while not stop.is_set():
        wait = under_way[0][0] - time.monotonic() if under_way else 0.1
        ready, _, _ = select.select(ends, [], [], max(0.0, wait))
        for end in ready:
            packet = os.read(end, 65536)
            if draw.random() >= loss:
                count += 1
                other = ends[1] if end == ends[0] else ends[0]
                heapq.heappush(under_way, (time.monotonic() + delay, count, other, packet))
        while under_way and under_way[0][0] <= time.monotonic():
            _, _, end, packet = heapq.heappop(under_way)
            os.write(end, packet)


def start_node(namespace: str, *more: str) -> subprocess.Popen[bytes]:
    """A node of Ray's that ends with the process that is returned."""
    address = ADDRESSES[namespace]
    command = ["ray", "start", "--block", f"--node-ip-address={address}", "--num-cpus=0", *more]
    command += [f"--object-store-memory={ray_cluster.OBJECT_STORE_BYTES}"]
    command[0] = str(Path(sys.executable).with_name("ray"))
    return subprocess.Popen(inside(namespace, *command), stdout=subprocess.DEVNULL)


def kill_raylet(node: subprocess.Popen[bytes]) -> None:
    """Have a node vanish without a word."""
    for children in Path(f"/proc/{node.pid}/task").glob("*/children"):
        for child in children.read_text().split():
            if "raylet/raylet" in Path(f"/proc/{child}/cmdline").read_text():
                os.kill(int(child), signal.SIGKILL)


def train(steps: int) -> None:
    """In the near namespace: step, and see one of the far nodes go."""
    import ray
    from cheetahs import NUM_ENVS, PLACED, entry, step_both

    from rlightning_aio import sync

    ray.init(address=f"{ADDRESSES[NEAR]}:{PORT}", log_to_driver=False)
    while sum(node["Alive"] for node in ray.nodes()) < 3:
        time.sleep(0.1)
    num_batches = steps // NUM_ENVS

    def say_when(number: int) -> None:
        if number == num_batches // 2:
            sys.stdout.write(HALFWAY)
            sys.stdout.flush()

    far = {"envs_per_process": NUM_ENVS // 2, "max_restarts": 20}
    with (
        sync.build_env_group(entry(**PLACED, **far)) as group,
        sync.build_env_group(entry(placement="inline")) as twins,
    ):
        told = step_both(group, twins, num_batches, say_when)
    ray_cluster.no_actor_left()
    median = statistics.median(told.batch_seconds)
    sys.stdout.write(f"{told}, {1e3 * median:.1f} ms a batch\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20_000, help="transitions of all envs")
    parser.add_argument("--delay-ms", type=float, default=5.0, help="of each packet, one way")
    parser.add_argument("--loss", type=float, default=0.001, help="share of the packets")
    parser.add_argument("--train", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.train:
        train(chosen.steps)
        return
    with ExitStack() as stack:
        for namespace in ADDRESSES:
            run("ip", "netns", "add", namespace)
            stack.callback(run, "ip", "netns", "delete", namespace)
        ends = [interface(namespace) for namespace in ADDRESSES]
        stop = threading.Event()
        link = threading.Thread(target=carry, args=(ends, chosen.delay_ms / 1e3, chosen.loss, stop))
        link.start()
        stack.callback(link.join)
        stack.callback(stop.set)
        far = (f"--address={ADDRESSES[NEAR]}:{PORT}", '--resources={"sim": 2}')
        nodes = [start_node(NEAR, "--head", f"--port={PORT}", "--include-dashboard=false")]
        time.sleep(5)
        nodes += [start_node(FAR, *far), start_node(FAR, *far)]
        for node in nodes:
            stack.callback(node.wait)
            stack.callback(node.terminate)
        command = [sys.executable, __file__, "--train", "--steps", str(chosen.steps)]
        trainer = subprocess.Popen(inside(NEAR, *command), stdout=subprocess.PIPE, text=True)
        assert trainer.stdout is not None
        for line in trainer.stdout:
            sys.stdout.write(line)
            if line == HALFWAY:
                kill_raylet(nodes[1])
        sys.exit(trainer.wait())


if __name__ == "__main__":
    main()
