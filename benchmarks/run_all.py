"""Run every benchmark, keep the reports and plots, and renew the tables of the results pages.

`tables.md` has the table of each script, and `README.md` the comparisons that matter most.

    python benchmarks/run_all.py              # all of them, twenty minutes
    python benchmarks/run_all.py cheetah pong
    python benchmarks/run_all.py training     # takes hours, so it runs only if it is named

The scripts run one after the other, each in its own interpreter.
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
from harness import machine_text, say, tables, target_row

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
TABLES = HERE / "tables.md"
README = HERE / "README.md"
SCRIPTS = (
    "adapters", "cheetah", "batches", "peers", "humanoid", "cartpole", "pong", "round_trip",
    "facade", "trainer_cpu", "stragglers", "uneven", "start", "memory", "remote", "pool",
    "tracing", "filming", "thread_share", "loop_pause", "headline", "exchange", "awaitable",
)  # fmt: skip
# Run only if they are named.
LONG = ("training",)
# Those whose comparisons the README shows.
SHOWN = ("headline", "batches", "exchange", "start")


def run_script(name: str) -> bool:
    """Run one script; return True if it ended well."""
    say(f"== {name}")
    command = [sys.executable, str(HERE / f"{name}.py"), "--json", str(RESULTS / f"{name}.json")]
    if find_spec("matplotlib") is not None:
        command += ["--plot", str(RESULTS / f"{name}.png")]
    return subprocess.run(command, check=False).returncode == 0


def with_table(text: str, name: str) -> str:
    """Return `text` with a new table of `name` between its two marks."""
    path = RESULTS / f"{name}.json"
    if not path.exists():
        absent = f"No figures of this version are kept; `python benchmarks/{name}.py` prints them."
        return between_marks(text, name, absent)
    report = json.loads(path.read_text())
    machine = machine_text(report["machine"])
    # A script with other figures makes its own tables.
    shown = report.get("tables") or tables(report)
    shown += f"\n\n{report['rounds']} rounds. {machine}"
    if path.with_suffix(".png").exists():
        shown += f"\n\n![{report['title']}](results/{name}.png)"
    return between_marks(text, name, shown)


def between_marks(text: str, name: str, shown: str) -> str:
    """`text` with `shown` between the two marks of `name`."""
    marks = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    return marks.sub(lambda found: f"{found[1]}\n{shown}\n\n{found[2]}", text)


def comparisons() -> str:
    """The comparisons of the scripts in `SHOWN` as one table, and the machine of each run."""
    lines = ["| compared | ratio | lowest to highest | target | |", "|---|---:|---:|---:|---|"]
    machines: list[str] = []
    for name in SHOWN:
        path = RESULTS / f"{name}.json"
        if path.exists():
            report = json.loads(path.read_text())
            lines += [target_row(target, report["unit"]) for target in report["targets"]]
            machines.append(machine_text(report["machine"]))
    return "\n".join(lines) + "\n\n" + "\n\n".join(dict.fromkeys(machines))


def renew_pages() -> None:
    """Renew the tables, the comparisons and the picture from the kept reports."""
    text = TABLES.read_text()
    for name in (*SCRIPTS, *LONG):
        text = with_table(text, name)
    TABLES.write_text(text)
    README.write_text(between_marks(README.read_text(), "comparisons", comparisons()))
    picture.PICTURE.write_text(picture.drawn(RESULTS))


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
    renew_pages()
    if failed:
        say(f"failed: {', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
