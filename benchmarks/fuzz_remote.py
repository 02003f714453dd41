"""Spoilt messages, hellos and keys against env_server, and what strangers cost a trainer.

    python benchmarks/fuzz_remote.py

First what the short form in the tests asserts, without sockets: every request between spoilt
messages was answered, how memory grew over the second half, and that spoilt key files keep
nobody out. Then a trainer with one honest client, and strangers in a process of their own who
send as many messages over ever new connections, to a server with keys and to one without.
Rounds of 2 s alternate: strangers stopped or not (by signal), the trainer stepping its client
or only waiting. Measured are the steps of a round, and the processor time of the trainer's
process, ZMQ's thread included, while it only waits. Strangers wait for the other end's part of the
handshake, so an env_server that makes them wait hears less than they would say: how much they have
sent, and what became of it, is told beside.
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
from remote.strangers import BATCH  # noqa: E402

GROWTH = 200_000
"""Bytes that the noted messages which are spoilt next may differ by."""
ROUND_SECONDS = 2.0
MOST_OF_A_CORE = 0.05
LEAST_RATE = 0.9
MOST_KEPT = 4 << 20
"""Bytes that a process may grow by from the first quarter of a run to its end."""


@dataclass
class Cost:
    """What strangers cost.

    Attributes:
        shares: of a core, that a waiting trainer takes, one for each round: without, with.
        rates: steps a second, likewise.
        grown: bytes, since the first quarter.
        cut: connections that were cut off.
        sent: messages, over connections that were not broken off before.
        read: messages of which somebody found out what they say.
        dropped: messages that were taken in and thrown away unread.
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
    """Processor time, as a share of a core, of a trainer that waits for its clients."""
    began, before = time.monotonic(), time.process_time()
    while (left := began + seconds - time.monotonic()) > 0:
        try:
            group.collect_async(deadline=max(1e-3, left))
        except TimeoutError:
            break
    return (time.process_time() - before) / (time.monotonic() - began)


def step(group, batch, seconds: float):
    """Steps a second, and the last batch."""
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
        strangers,
    ):
        strangers.send_signal(signal.SIGSTOP)
        batch, _ = group.reset()
        with group.auto_reset(max_episode_steps=1000):
            step(group, batch, 1.0)
            first = 0
            while strangers.poll() is None and found.seconds < 10 * messages / rate:
                for disturbance in (False, True):
                    if disturbance:
                        strangers.send_signal(signal.SIGCONT)
                    reached, batch = step(group, batch, ROUND_SECONDS)
                    found.rates[disturbance].append(reached)
                    found.shares[disturbance].append(wait(group, ROUND_SECONDS))
                    if disturbance:
                        strangers.send_signal(signal.SIGSTOP)
                        found.seconds += 2 * ROUND_SECONDS
                if not first and found.seconds >= messages / rate / 4:
                    first = resident()
        found.grown = resident() - first
        door = listener.door
        found.cut, found.read, found.dropped = door.num_cut, door.num_wasted, door.num_dropped
        strangers.kill()
        strangers.wait()
        found.sent = BATCH * len(strangers.stdout.read())
    return found


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=100_000, help="against each end")
    parser.add_argument("--messages", type=int, default=100_000, help="of strangers, each time")
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
            f"{given.messages:,} messages of strangers at {given.rate:,} a second, "
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
