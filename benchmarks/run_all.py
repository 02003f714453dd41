"""Run the benchmarks that have results, keep the reports, and renew what shows them.

`tables.md` has the table of each, and `docs/pictures/speed.svg` is drawn from the first.

    python benchmarks/run_all.py                      # all of them, a quarter of an hour
    python benchmarks/run_all.py exchange remote
    python benchmarks/run_all.py --pages              # only what shows the kept reports

They run one after the other, each in its own interpreter.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path
from xml.sax.saxutils import escape

from harness import machine_text, say, tables

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
TABLES = HERE / "tables.md"
PICTURE = HERE.parent / "docs" / "pictures" / "speed.svg"
UNEVEN = ["waiting:benchmarks/Uneven-v0", "64", "--ready", "1", "--envs-per-process", "1"]
RUNS = {
    "HalfCheetah-v5-32": ["compare", "HalfCheetah-v5", "32"],
    "CartPole-v1-64": ["compare", "CartPole-v1", "64"],
    "Humanoid-v5-16": ["compare", "Humanoid-v5", "16"],
    "Pong-v5-8": ["compare", "ale_py:ALE/Pong-v5", "8"],
    # Several times the 1.6 seconds of a full cycle of an env's times.
    "Uneven-v0-64": ["compare", *UNEVEN, "--seconds", "5"],
    "own_envs": ["own_envs"],
    "exchange": ["exchange"],
    "awaitable": ["awaitable"],
    "remote": ["remote"],
}
"""The name of each report, and the program with its arguments that writes it."""
PICTURED = next(iter(RUNS))
WIDTH, TOP, LEFT, LONGEST, BAR, GAP = 400, 56, 188, 152, 20, 6
STYLE = """text{font-size:12px;font-family:sans-serif;fill:#222}.page{fill:#fff}
.ours{fill:#3f51b5}.theirs{fill:#b0b4c3}
@media(prefers-color-scheme:dark){text{fill:#eee}.page{fill:#1e2129}.ours{fill:#7986cb}
.theirs{fill:#666d80}}"""


def run(name: str) -> bool:
    """Run one of `RUNS`; return True if it ended well."""
    say(f"== {name}")
    program, *arguments = RUNS[name]
    command = [sys.executable, str(HERE / f"{program}.py"), *arguments]
    command += ["--json", str(RESULTS / f"{name}.json")]
    return subprocess.run(command, check=False).returncode == 0


def shown(name: str) -> str:
    """Return the tables of a kept report, and how they came about."""
    path = RESULTS / f"{name}.json"
    command = f"`python benchmarks/{RUNS[name][0]}.py {' '.join(RUNS[name][1:])}".rstrip() + "`"
    if not path.exists():
        return f"No figures of this version are kept; {command} prints them."
    report = json.loads(path.read_text())
    about = f"{command}, {report['rounds']} rounds"
    if "step_timeout" in report:
        limit = report["step_timeout"]
        about += f", {f'time limits of {limit:g} s' if limit else 'without time limits'}"
    own = report.get("tables") or tables(report)
    return f"{own}\n\n{about}. {machine_text(report['machine'])}"


def between_marks(text: str, name: str, new: str) -> str:
    """`text` with `new` between the two marks of `name`."""
    marks = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    return marks.sub(lambda found: f"{found[1]}\n{new}\n\n{found[2]}", text)


def renew_pages() -> None:
    """Renew the tables and the picture from the kept reports."""
    text = TABLES.read_text()
    for name in RUNS:
        text = between_marks(text, name, shown(name))
    TABLES.write_text(text)
    PICTURE.write_text(drawn(RESULTS))


def drawn(results: Path) -> str:
    """Return the picture as SVG: env steps per second of all in `PICTURED`, a bar for each."""
    report = json.loads((results / f"{PICTURED}.json").read_text())
    rates = {name: found["median"] for name, found in report["results"].items()}
    height, machine = TOP + len(rates) * (BAR + GAP) + GAP, report["machine"]
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="600">',
        f"<title>{escape(report['title'])}</title><style>{STYLE}</style>",
        f'<rect width="{WIDTH}" height="{height}" rx="6" class="page"/>',
        _text(10, 20, f"{report['title']}: env steps per second", weight="bold"),
        _text(10, 38, f"{machine['cores']} cores ({machine['cpu']}), {machine['date']}"),
    ]
    for row, name in enumerate(sorted(rates, key=lambda name: -rates[name])):
        y, length = TOP + row * (BAR + GAP), LONGEST * rates[name] / max(rates.values())
        kind = "ours" if name.startswith("rlightning_aio") else "theirs"
        shape = f'x="{LEFT}" y="{y}" width="{length:.0f}" height="{BAR}" rx="3"'
        parts += [
            _text(10, y + 14, name),
            f'<rect {shape} class="{kind}"/>',
            # Three digits, as in the tables.
            _text(LEFT + length + 6, y + 14, f"{float(f'{rates[name]:.3g}'):,.0f}"),
        ]
    return "\n".join([*parts, "</svg>", ""])


def _text(x: float, y: int, text: str, *, weight: str = "normal") -> str:
    return f'<text x="{x:.0f}" y="{y}" font-weight="{weight}">{escape(text)}</text>'


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of: {', '.join(RUNS)}")
    parser.add_argument("--pages", action="store_true", help="run nothing, renew pages")
    given = parser.parse_args()
    names = [] if given.pages else given.names or list(RUNS)
    if unknown := set(names) - set(RUNS):
        parser.error(f"no such benchmark: {', '.join(sorted(unknown))}")
    failed = [name for name in names if not run(name)]
    renew_pages()
    if failed:
        say(f"failed: {', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
