"""Spoilt messages against both ends of env_server, as many as asked for.

    python benchmarks/fuzz_remote.py --frames 100000

It prints what the short form in the tests asserts: every request between them was
answered, what was recognised as no message, and how memory grew over the second half.
"""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

# In place of this directory, whose remote.py is another.
sys.path[0] = str(Path(__file__).resolve().parents[1] / "tests")

from remote.fuzz import fuzz  # noqa: E402  (it lies beside its short form)

GROWTH = 200_000
"""Bytes that the noted messages which are spoilt next may differ by."""


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=100_000, help="against each end")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    findings = fuzz(given.frames, given.seed)
    print(f"{findings.frames:,} spoilt messages to each end")
    print(f"{findings.malformed:,} dropped as no message")
    print(f"{findings.steps:,} requests between them, each answered")
    print(f"{findings.grown:+,} bytes held more after the second half than after the first")
    return 1 if findings.grown > GROWTH else 0


if __name__ == "__main__":
    sys.exit(main())
