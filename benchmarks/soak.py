"""Millions of steps in hundreds of groups, one after the other: does anything leak?

    python benchmarks/soak.py
    python benchmarks/soak.py --cycles 20 --steps 100000

Every cycle builds a group of CartPole envs, steps it and closes it, alternately with and without
an event loop. Descriptors, child processes and resident memory are printed over time. Exit code
1: more descriptors or processes than after the first cycles, or memory that has grown by more
than a few MiB.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from harness import machine_facts, machine_text, shared_memory

import rlightning_aio as rl
from rlightning_aio import sync

ENVS = 16
ALLOWED_MIB = 8.0
"""Allowed growth of memory after the first tenth of the cycles, for the allocator."""
SAMPLES = 20
ENTRY = {
    "name": "pole",
    "backend": "gymnasium",
    "task": "CartPole-v1",
    "num_workers": ENVS,
    "envs_per_process": ENVS // 2,
}


def actions(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.integers(2, size=count)


def cycle_sync(steps: int, rng: np.random.Generator) -> int:
    """Step a group synchronously; return the number of steps."""
    done = 0
    with sync.build_env_group(ENTRY) as group, group.auto_reset(500):
        batch, _ = group.reset(seed=0)
        while done < steps:
            batch, _ = group.step(batch.respond(action=actions(rng, ENVS)))
            done += ENVS
    return done


async def cycle_async(steps: int, rng: np.random.Generator) -> int:
    """Step the half of a group that is ready first; return the number of steps."""
    done = 0
    async with rl.build_env_group(ENTRY) as group:
        with group.auto_reset(500):
            batch, _ = await group.reset(seed=0)
            while done < steps:
                group.step_async(batch.respond(action=actions(rng, len(batch))))
                batch, _ = await group.collect_async(min_results=ENVS // 2)
                done += len(batch)
    return done


def sample() -> dict[str, float]:
    """Return the resources of this process, without a forced garbage collection."""
    children = [
        pid
        for path in Path("/proc/self/task").glob("*/children")
        for pid in path.read_text().split()
    ]
    descriptors = 0
    for path in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):  # The descriptor of the listing itself.
            descriptors += bool(path.readlink())
    rss_kib = next(
        int(line.split()[1])
        for line in Path("/proc/self/status").read_text().splitlines()
        if line.startswith("VmRSS")
    )
    return {
        "descriptors": descriptors,
        "children": len(children),
        "shared_memory": len(shared_memory()),
        "rss_mib": rss_kib / 1024,
    }


def soak(cycles: int, steps: int) -> dict[str, Any]:
    """Run the cycles; return samples over time."""
    rng = np.random.default_rng(0)
    samples: list[dict[str, float]] = []
    began, done = time.monotonic(), 0
    shown = {max(1, round(cycles * k / SAMPLES)) for k in range(1, SAMPLES + 1)}
    print("| cycles | steps | s | descriptors | children | shared memory | RSS, MiB |")
    print("|---:|---:|---:|---:|---:|---:|---:|")
    for cycle in range(1, cycles + 1):
        wanted = steps * cycle // cycles - steps * (cycle - 1) // cycles
        done += cycle_sync(wanted, rng) if cycle % 2 else rl.run(cycle_async(wanted, rng))
        if cycle in shown:
            found = {"cycle": cycle, "steps": done, "seconds": time.monotonic() - began, **sample()}
            samples.append(found)
            print(
                f"| {cycle} | {done:,} | {found['seconds']:.0f} | {found['descriptors']} | "
                f"{found['children']} | {found['shared_memory']} | {found['rss_mib']:.1f} |",
                flush=True,
            )
    return {"samples": samples, "growth": growth(samples, cycles)}


def growth(samples: list[dict[str, float]], cycles: int) -> dict[str, float]:
    """Return the growth since the first tenth of the cycles, which warms up caches."""
    first = next(found for found in samples if found["cycle"] >= min(cycles, max(2, cycles // 10)))
    return {name: samples[-1][name] - first[name] for name in sample()}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cycles", type=int, default=200, help="default: %(default)s")
    parser.add_argument("--steps", type=int, default=5_000_000, help="of all cycles together")
    parser.add_argument("--json", type=Path, help="also write the report to this file")
    arguments = parser.parse_args()
    report = soak(arguments.cycles, arguments.steps)
    report["machine"] = machine_facts([])
    grown = report["growth"]
    flat = grown["rss_mib"] <= ALLOWED_MIB and not any(
        grown[name] > 0 for name in ("descriptors", "children", "shared_memory")
    )
    told = ", ".join(f"{name} {value:+.1f}" for name, value in grown.items())
    print(f"\nSince the first tenth: {told}: {'flat' if flat else 'NOT flat'}.")
    print(f"\n{machine_text(report['machine'])}")
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    return 0 if flat else 1


if __name__ == "__main__":
    sys.exit(main())
