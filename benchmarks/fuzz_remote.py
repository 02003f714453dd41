"""Corrupted messages, hellos and keys for env_server, and the cost of unauthenticated peers.

    python benchmarks/fuzz_remote.py

First, without sockets, the assertions of the short form in the tests: every request between
corrupted messages is answered, memory doesn't grow over the second half, and corrupted key files
lock out no client. Then a trainer with one honest client, and peers in another process that send
as many messages as they can over new connections, to a server with keys and to one without.
Rounds of 2 s alternate: peers stopped or not (by signal), the trainer stepping its client
or only waiting. The figures are the steps of a round, and the processor time of the trainer's
process, including ZMQ's thread, while it only waits. Unauthenticated peers wait for the other
end's part of the handshake, so an env_server that makes them wait receives less. The numbers of
messages that were sent, read and dropped are printed, too.
"""

from __future__ import annotations

import argparse
import logging
import signal
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

# In place of this directory, whose remote.py is another.
sys.path[0] = str(Path(__file__).resolve().parents[1] / "tests")

from remote.disturbed import disturbed  # noqa: E402  (they lie beside their short form)
from remote.fuzz import fuzz, fuzz_keys  # noqa: E402
from remote.unauthenticated_peers import BATCH  # noqa: E402

GROWTH = 200_000
"""Largest difference in bytes of the recorded messages that are corrupted next."""
ROUND_SECONDS = 2.0
MOST_OF_A_CORE = 0.05
LEAST_RATE = 0.9
MOST_KEPT = 4 << 20
"""Largest growth of a process in bytes from the first quarter of a run to its end."""


@dataclass
class Cost:
    """The cost of unauthenticated peers.

    Attributes:
        shares: of a core that a waiting trainer uses, for each round: without peers, with peers.
        rates: steps a second, likewise.
        grown: bytes, since the first quarter.
        cut: closed connections.
        sent: messages, over connections that were open at that time.
        read: messages whose content was read.
        dropped: messages that were received and dropped unread.
    """

    shares: tuple[list[float], list[float]] = field(default_factory=lambda: ([], []))
    rates: tuple[list[float], list[float]] = field(default_factory=lambda: ([], []))
    seconds: float = 0.0
    grown: int = 0
    cut: int = 0
    sent: int = 0
    read: int = 0
    dropped: int = 0


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def wait(group, seconds: float) -> float:
    """Return the processor time, as a share of a core, of a trainer that waits for its clients."""
    began, before = time.monotonic(), time.process_time()
    while (left := began + seconds - time.monotonic()) > 0:
        try:
            group.collect_async(deadline=max(1e-3, left))
        except TimeoutError:
            break
    return (time.process_time() - before) / (time.monotonic() - began)


def step(group, batch, seconds: float):
    """Return the steps per second, and the last batch."""
    began, steps = time.monotonic(), 0
    while time.monotonic() < began + seconds:
        group.step_async(batch.respond(action=[0]))
        batch, _ = group.collect_async(deadline=60)
        steps += 1
    return steps / (time.monotonic() - began), batch


def cost(messages: int, rate: int, seed: int, *, curve: bool) -> Cost:
    found = Cost()
    with disturbed(curve=curve, messages=messages, rate=rate, seed=seed) as (
        group,
        listener,
        peers,
    ):
        peers.send_signal(signal.SIGSTOP)
        batch, _ = group.reset()
        with group.auto_reset(max_episode_steps=1000):
            step(group, batch, 1.0)
            first = 0
            while peers.poll() is None and found.seconds < 10 * messages / rate:
                for disturbance in (False, True):
                    if disturbance:
                        peers.send_signal(signal.SIGCONT)
                    reached, batch = step(group, batch, ROUND_SECONDS)
                    found.rates[disturbance].append(reached)
                    found.shares[disturbance].append(wait(group, ROUND_SECONDS))
                    if disturbance:
                        peers.send_signal(signal.SIGSTOP)
                        found.seconds += 2 * ROUND_SECONDS
                if not first and found.seconds >= messages / rate / 4:
                    first = resident()
        found.grown = resident() - first
        limiter = listener.connections
        found.cut, found.read, found.dropped = (
            limiter.num_cut,
            limiter.num_wasted,
            limiter.num_dropped,
        )
        peers.kill()
        peers.wait()
        found.sent = BATCH * len(peers.stdout.read())
    return found


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=100_000, help="against each end")
    parser.add_argument("--messages", type=int, default=100_000, help="of peers, each time")
    parser.add_argument("--rate", type=int, default=2500, help="messages a second, at most")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    misses = 0
    if given.frames:
        findings = fuzz(given.frames, given.seed)
        print(f"{findings.frames:,} spoilt messages to each end, a fifth of the server's hellos")
        print(f"{findings.malformed:,} dropped as no message")
        print(f"{findings.steps:,} requests between them, each answered")
        print(f"{findings.grown:+,} bytes held more after the second half than after the first")
        with tempfile.TemporaryDirectory() as directory:
            files = given.frames // 50
            unknown = fuzz_keys(files, given.seed, Path(directory))
        print(f"{files:,} spoilt key files, beside which a good one was unknown {unknown} times")
        misses += (findings.grown > GROWTH) + (unknown > 0)
    for curve in (True, False):
        found = cost(given.messages, given.rate, given.seed, curve=curve)
        quiet, loud = (median(shares) for shares in found.shares)
        rate = median(b / a for a, b in zip(*found.rates, strict=True))
        print(
            f"{given.messages:,} messages of peers at {given.rate:,} a second, "
            f"{'keys' if curve else 'no keys'}: after {found.seconds:.0f} s {found.sent:,} sent, "
            f"{found.read:,} read, {found.dropped:,} dropped; {loud - quiet:.1%} of a core more "
            f"({loud:.1%} against {quiet:.1%}); the client steps at "
            f"{rate:.2f} of its rate ({median(found.rates[0]):,.0f} a second); "
            f"{found.cut:,} connections cut off; {found.grown:+,} bytes resident"
        )
        misses += (loud - quiet > MOST_OF_A_CORE) + (rate < LEAST_RATE)
        misses += found.grown > MOST_KEPT
    return 1 if misses else 0


if __name__ == "__main__":
    sys.exit(main())
