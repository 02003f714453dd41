"""`make simulate`: run many programs, or replay the one of a seed."""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter

from simulator.coverage import FAULTS, report
from simulator.program import draw
from simulator.runs import WORLDLY, prepare, run, run_many, run_twice, shown, shrunk


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="simulate", description=__doc__)
    parser.add_argument("--seeds", type=int, default=1000, help="how many programs")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--seed", type=int, help="replay the program of this seed")
    parser.add_argument("--real", action="store_true", help="with real processes")
    parser.add_argument("--without", default="", help="features, separated by commas")
    parser.add_argument("--stop", action="store_true", help="at the first failure")
    parser.add_argument("--once", action="store_true", help="each once, not twice")
    arguments = parser.parse_args()
    without = frozenset(filter(None, arguments.without.split(",")))
    without |= WORLDLY if arguments.real else frozenset()
    again = (lambda p: run(p, real=True)) if arguments.real else run_twice
    if arguments.seed is not None:
        prepare()
        program = draw(arguments.seed, without=without)
        print(shown(found := again(program)))
        return bool(found.error)
    began, counts, hours, failed = time.perf_counter(), Counter[str](), 0.0, []
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    for found in run_many(seeds, without, real=arguments.real, once=arguments.once):
        counts += found.counts
        hours += found.hours
        if found.error:
            failed.append(found)
            print(f"seed {found.program.seed}: {found.kind}", flush=True)
            if arguments.stop:
                return 1
    seconds = time.perf_counter() - began
    ops = sum(count for name, count in counts.items() if name.startswith("op "))
    faults = sum(counts[name] for name in FAULTS)
    print(
        f"{len(seeds)} programs, {len(failed)} failed: {seconds:.0f} s, {hours:.1f} simulated hours"
    )
    print(f"{ops} operations, {faults} faults, {faults / seconds:.0f} a second")
    for name, count in sorted(counts.items()):
        if not name.startswith(("request ", "loss ", "op ")):
            print(f"{count:9d} {name}")
    print(*report(counts), sep="\n")
    if failed:
        prepare()
        print("\nThe first failure, made as small as it gets:\n")
        print(shown(shrunk(failed[0], again)))
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
