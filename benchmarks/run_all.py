"""Run every benchmark, keep the reports and plots, and renew the tables of the README.

    python benchmarks/run_all.py              # all of them, about a quarter of an hour
    python benchmarks/run_all.py cheetah pong
    python benchmarks/run_all.py training     # hours, and so only if it is named

Each script runs in an interpreter of its own, one after the other.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import picture
from harness import machine_text, say, tables

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
README = HERE / "README.md"
SCRIPTS = (
    "adapters", "cheetah", "batches", "peers", "humanoid", "cartpole", "pong", "round_trip",
    "facade", "trainer_cpu", "stragglers", "uneven", "start", "memory", "remote", "worker", "pool",
    "tracing", "filming",
)  # fmt: skip
# Run only if they are named.
LONG = ("training",)


def run_script(name: str) -> bool:
    """Run one script; whether it has ended well."""
    say(f"== {name}")
    command = [sys.executable, str(HERE / f"{name}.py"), "--json", str(RESULTS / f"{name}.json")]
    if find_spec("matplotlib") is not None:
        command += ["--plot", str(RESULTS / f"{name}.png")]
    return subprocess.run(command, check=False).returncode == 0


def with_table(text: str, name: str) -> str:
    """`text` with the table of `name` between its two marks renewed."""
    path = RESULTS / f"{name}.json"
    if not path.exists():
        return text
    report = json.loads(path.read_text())
    machine = machine_text(report["machine"])
    # A script whose figures are of another shape brings its tables along.
    shown = report.get("tables") or tables(report)
    shown += f"\n\n{report['rounds']} rounds. {machine}"
    if path.with_suffix(".png").exists():
        shown += f"\n\n![{report['title']}](results/{name}.png)"
    marks = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    return marks.sub(lambda found: f"{found[1]}\n{shown}\n\n{found[2]}", text)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    known = (*SCRIPTS, *LONG)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of: {', '.join(known)}")
    names = parser.parse_args().names or SCRIPTS
    if unknown := set(names) - set(known):
        parser.error(f"no such benchmark: {', '.join(sorted(unknown))}")
    RESULTS.mkdir(exist_ok=True)
    failed = [name for name in names if not run_script(name)]
    text = README.read_text()
    for name in known:
        text = with_table(text, name)
    README.write_text(text)
    picture.PICTURE.write_text(picture.drawn(RESULTS))
    if failed:
        say(f"failed: {', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
