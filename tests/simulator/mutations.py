"""Defects that were fixed, put back one at a time: how many seeds find each.

`make mutations` applies each of `mutations.toml` to a copy of `src`, and runs programs until one
fails that does not fail without it. A text that `src` no longer has must be changed along.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from simulator.program import draw
from simulator.runs import prepare, run

if TYPE_CHECKING:
    from collections.abc import Sequence

    from simulator.program import Program

ROOT: Final = Path(__file__).parents[2]
TABLE: Final = Path(__file__).with_suffix(".toml")


@dataclass(frozen=True)
class Mutation:
    """A defect.

    Attributes:
        what: was wrong.
        source: the commit that fixed it, or the test that looked for such defects.
        changes: files of the package, each with a text and what it becomes.
        kinds, features: of the programs that can show it; no others are run.
    """

    name: str
    what: str
    source: str
    changes: Sequence[dict[str, str]]
    kinds: Sequence[str]
    features: frozenset[str]

    @classmethod
    def of(cls, given: dict[str, Any]) -> Mutation:
        """The defect of an entry of the table."""
        source = given.get("commit") or given["test"]
        kinds, features = given.get("kinds", ()), frozenset(given.get("features", ()))
        return cls(given["name"], given["what"], source, given["change"], kinds, features)

    def may_be_in(self, program: Program) -> bool:
        """Return True if a program can show it."""
        return program.kind in (self.kinds or (program.kind,)) and self.features <= program.features

    def apply(self, package: Path) -> bool:
        """Put it into a copy of the package; False if that has another text by now."""
        for change in self.changes:
            file = package / change["file"]
            text = file.read_text()
            if text.count(change["now"]) != 1:
                return False
            file.write_text(text.replace(change["now"], change["then"]))
        return True


def mutations() -> list[Mutation]:
    """All of the table."""
    return [Mutation.of(given) for given in tomllib.loads(TABLE.read_text())["defect"]]


def search(mutation: Mutation, seeds: range) -> tuple[int, str] | None:
    """Run programs in this process; return the first seed that fails, and how."""
    prepare()
    for seed in seeds:
        program = draw(seed)
        if mutation.may_be_in(program) and (found := run(program)).error:
            return seed, found.error.strip().splitlines()[-1][:100]
    return None


def search_apart(mutation: Mutation, source: Path, first: int, most: int) -> tuple[int, str] | None:
    """As `search`, with the package that is in `source`."""
    path = f"{source}{os.pathsep}{ROOT / 'tests'}"
    words = [str(word) for word in ("--search", first, "--most", most, "--only", mutation.name)]
    done = subprocess.run(
        [sys.executable, "-m", "simulator.mutations", *words],
        env=os.environ | {"PYTHONPATH": path},
        stdout=subprocess.PIPE, text=True, check=True,
    )  # fmt: skip
    seed, _, how = done.stdout.strip().partition(" ")
    return (int(seed), how) if seed else None


def found_by(mutation: Mutation, first: int, most: int) -> tuple[str, str]:
    """Return how many seeds it takes to find it, and what they find."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "src")
        shutil.copytree(ROOT / "src", source, ignore=shutil.ignore_patterns("__pycache__"))
        if not mutation.apply(source / "rlightning_aio"):
            return "outdated", ""
        while first < most:
            found = search_apart(mutation, source, first, most)
            if found is None:
                break
            seed, how = found
            if search_apart(mutation, ROOT / "src", seed, seed + 1) is None:
                return str(seed + 1), how
            first = seed + 1  # It fails without the defect, too.
    return "not found", ""


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="mutations", description=__doc__)
    parser.add_argument("--only", nargs="*", help="names of defects")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--most", type=int, default=2000, help="the seed after the last")
    parser.add_argument("--search", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    chosen = [one for one in mutations() if given.only is None or one.name in given.only]
    if given.search is not None:
        found = search(chosen[0], range(given.search, given.most))
        sys.stdout.write("" if found is None else " ".join(map(str, found)))
        return 0
    sys.stdout.write("| defect | of | seeds | found as |\n|---|---|---|---|\n")
    missed = 0
    for one in chosen:
        seeds, how = found_by(one, given.first, given.most)
        missed += not seeds.isdecimal()
        how = how.replace("|", "/")
        sys.stdout.write(f"| {one.name}: {one.what} | {one.source} | {seeds} | {how} |\n")
        sys.stdout.flush()
    sys.stdout.write(f"\n{len(chosen) - missed} of {len(chosen)} found\n")
    return missed > 0


if __name__ == "__main__":
    sys.exit(main())
