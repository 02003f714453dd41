"""Alternating rounds of contenders in one run, and their reports.

Rule: contenders take turns (see `rlightning_aio.cli.measurement`), each in its own process, which
sleeps during the turns of others.
Left out on purpose: the work to measure, which is in the scripts, one question each.
"""

from __future__ import annotations

import argparse
import copy
import importlib.util
import json
import multiprocessing as mp
import os
import sys
import tempfile
import time
import traceback
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self
from unittest.mock import patch

from rlightning_aio.cli.measurement import Figures, family, in_turns, machine_facts

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from multiprocessing.connection import Connection

# One math thread for each contender: none is faster with more, and some would
# start one for each core in each of their processes.
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
NAME_WIDTH = 34
STEPS = "env steps/s"
"""The unit of figures with which processor time can be told by env step, too."""


class Contender:
    """One way to do the work; subclasses are dataclasses that can be pickled.

    Everything but the constructor runs in the contender's own process.

    Attributes:
        source: a folder that is searched for modules before all others.
    """

    name: str
    source: str = ""

    @property
    def requires(self) -> tuple[str, ...]:
        """Return the modules without which it is left out."""
        return ()

    @property
    def is_ours(self) -> bool:
        return "rlightning_aio" in self.requires

    def setup(self) -> None:
        """Prepare the first round; called once, not measured."""

    def round(self, seconds: float) -> Any:
        """Run one round of about that length; return the figure, or all of them by column."""
        raise NotImplementedError

    def teardown(self) -> None:
        """Clean up after the last round; called once, also if a round has failed."""


def beside(contender: Contender, source: Path) -> Contender:
    """Return the contender as it is with the library of another checkout, in `source`/src."""
    other = copy.copy(contender)
    other.name = f"{contender.name}, of {source.name}"
    other.source = str(source.resolve() / "src")
    return other


@dataclass(frozen=True)
class Target:
    """A bound for the ratio of `subject` and `reference`, both contenders' names.

    Attributes:
        bound: of the ratio of their figures in the same round.
        at_most: the bound is an upper one.
    """

    subject: str
    reference: str
    bound: float
    at_most: bool = False

    def is_met(self, value: float) -> bool:
        return value <= self.bound if self.at_most else value >= self.bound


@dataclass(frozen=True)
class Question:
    """The question that a script answers.

    Attributes:
        name: of the result files.
        title: one line, with the workload.
        unit: of the contenders' figures; the column that is compared, where there are several.
        reference: the name of the contender of which the others' figures are given as multiples;
            the first that took part if this one didn't; empty for none.
        seconds: length of a round.
    """

    name: str
    title: str
    unit: str
    contenders: Sequence[Contender]
    targets: Sequence[Target] = ()
    reference: str = ""
    rounds: int = 7
    seconds: float = 1.5
    columns: Sequence[str] = ()
    """Of the table, where a round returns several figures."""

    def figure(self, value: Any) -> float:
        """Return what is compared of the value of a round."""
        return value[self.unit] if self.columns else value


def throughput(step: Callable[[], int], seconds: float) -> float:
    """Return the results per second of `step`, which returns the number of its results.

    The first tenth of the time is not counted: caches fill again after other contenders, and
    leftover work of the last round is used up.
    """
    clock = time.perf_counter
    until = clock() + 0.1 * seconds
    while clock() < until:
        step()
    count = 0
    began = now = clock()
    until = began + 0.9 * seconds
    while now < until:
        count += step()
        now = clock()
    return count / (now - began)


def busy_ns(pids: Iterable[int]) -> int:
    """Return the processor time that all threads of these processes have used so far."""
    found = 0
    for pid in pids:
        for thread in Path(f"/proc/{pid}/task").glob("*"):
            with suppress(FileNotFoundError, ProcessLookupError):
                found += int(thread.joinpath("schedstat").read_text().split()[0])
    return found


class ContenderFailed(Exception):
    """A contender raised or died; the text has the reason."""


class Stage:
    """A contender's process."""

    def __init__(self, contender: Contender) -> None:
        self.contender = contender

    def __enter__(self) -> Self:
        context = mp.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_perform, args=(theirs, self.contender))
        first = filter(None, [self.contender.source])
        with patch.object(sys, "path", [*first, *sys.path]):
            self._process.start()
        theirs.close()
        self._answer()
        return self

    def round(self, seconds: float) -> tuple[Any, float]:
        """Run a round; return its value, and how many processors all its processes kept busy."""
        assert self._process.pid is not None
        before, began = busy_ns(family(self._process.pid)), time.perf_counter_ns()
        self._connection.send(seconds)
        value = self._answer()
        wall = time.perf_counter_ns() - began
        return value, (busy_ns(family(self._process.pid)) - before) / wall

    def _answer(self) -> Any:
        try:
            value, trouble = self._connection.recv()
        except EOFError:
            self._process.join()
            raise ContenderFailed(f"its process ended with {self._process.exitcode}") from None
        if trouble:
            raise ContenderFailed(trouble)
        return value

    def __exit__(self, *error: object) -> None:
        self._connection.close()
        self._process.join(30)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _perform(connection: Connection, contender: Contender) -> None:
    """Run in the contender's process: rounds on request, until the pipe ends."""
    with tempfile.TemporaryDirectory() as folder, (Path(folder) / "output").open("w+b") as output:
        # The default of a user's script; a spawned process would spawn its children, too.
        mp.set_start_method(mp.get_all_start_methods()[0], force=True)
        # Simulators print, and MuJoCo writes a log into the working directory.
        os.chdir(folder)
        for descriptor in (1, 2):
            os.dup2(output.fileno(), descriptor)
        try:
            contender.setup()
            connection.send((0.0, ""))
            while True:
                connection.send((contender.round(connection.recv()), ""))
        except (EOFError, BrokenPipeError):
            pass
        except Exception:  # noqa: BLE001  Whatever it is, the run goes on without it.
            output.seek(0)
            printed = output.read().decode(errors="replace")[-2000:]
            connection.send((0.0, f"{traceback.format_exc()}{printed}"))
        finally:
            contender.teardown()
            os.chdir("/")


def measure(question: Question, given: argparse.Namespace) -> dict[str, Any]:
    """Run a question as the command line says; return its report as plain data."""
    turns, skipped = take_turns(question, given)
    figures = {
        name: Figures([question.figure(value) for value, _ in found])
        for name, found in turns.items()
    }
    reference = question.reference
    if reference and reference not in figures:
        reference = next(iter(figures), "")
    results: dict[str, dict[str, Any]] = {}
    for name, found in figures.items():
        results[name] = found.as_json()
        for column in question.columns:
            values = Figures([value[column] for value, _ in turns[name]])
            results[name].setdefault("columns", {})[column] = values.as_json()
        cores = [cores for _, cores in turns[name]]
        if question.unit == STEPS:
            spent = [1e6 * busy / rate for busy, rate in zip(cores, found.values, strict=True)]
            results[name]["cpu_us_per_step"] = Figures(spent).median
            results[name]["cores_used"] = Figures(cores).median
        if reference:
            results[name]["times"] = found.over(figures[reference]).as_json()
    return {
        "name": question.name,
        "title": question.title,
        "unit": question.unit,
        "rounds": given.rounds,
        "seconds": given.seconds,
        "reference": reference,
        "columns": list(question.columns),
        "machine": machine_facts({one for each in question.contenders for one in each.requires}),
        "results": results,
        "targets": [
            _judged(target, figures)
            for target in question.targets
            if {target.subject, target.reference} <= figures.keys()
        ],
        "skipped": skipped,
    }


def take_turns(
    question: Question, given: argparse.Namespace
) -> tuple[dict[str, list[tuple[Any, float]]], dict[str, str]]:
    """Let contenders take turns, each in its own process, with one math thread.

    Returns the values and the busy processors of each contender's rounds, and the reasons why
    others were left out.
    """
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    found: dict[str, list[tuple[Any, float]]] = {}
    skipped: dict[str, str] = {}
    with ExitStack() as stack:
        stages = _stages(question.contenders, given, stack, skipped)
        for number, stage in in_turns(stages, given.rounds):
            name = stage.contender.name
            try:
                value, cores = stage.round(given.seconds)
            except ContenderFailed as error:
                stages.remove(stage)
                found.pop(name, None)
                skipped[name] = _last_line(name, error)
                continue
            found.setdefault(name, []).append((value, cores))
            text = number_text(question.figure(value))
            say(f"  round {number + 1}/{given.rounds}  {name:{NAME_WIDTH}} {text}")
    return found, skipped


def _stages(
    contenders: Sequence[Contender],
    given: argparse.Namespace,
    stack: ExitStack,
    skipped: dict[str, str],
) -> list[Stage]:
    asked = [
        one for one in contenders if not given.only or any(part in one.name for part in given.only)
    ]
    if given.beside:
        pairs = [(one, beside(one, given.beside)) for one in asked]
        asked = [one for pair in pairs for one in pair if not one.source or one.is_ours]
    stages: list[Stage] = []
    for contender in asked:
        missing = [name for name in contender.requires if importlib.util.find_spec(name) is None]
        if missing:
            skipped[contender.name] = f"needs {', '.join(missing)}"
            continue
        try:
            stages.append(stack.enter_context(Stage(contender)))
        except ContenderFailed as error:
            skipped[contender.name] = _last_line(contender.name, error)
    return stages


def _last_line(name: str, error: ContenderFailed) -> str:
    say(f"{name} failed:\n{error}")
    lines = [line for line in str(error).splitlines() if line.strip()]
    return f"failed: {lines[-1].strip()}" if lines else "failed"


def _judged(target: Target, figures: dict[str, Figures]) -> dict[str, Any]:
    found = figures[target.subject].over(figures[target.reference])
    return {**asdict(target), **found.as_json(), "met": target.is_met(found.median)}


# ---- reports


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def number_text(value: float) -> str:
    """Format a number with three significant digits and thousands separators."""
    if abs(value) >= 1000:
        digits = len(str(int(abs(value)))) - 3
        return f"{round(value, -digits):,.0f}"
    return f"{value:.3g}"


def spread_text(found: dict[str, Any]) -> str:
    return f"{number_text(found['low'])} to {number_text(found['high'])}"


def full_text(found: dict[str, Any]) -> str:
    """Return a median, and its range unless it was measured once."""
    median = number_text(found["median"])
    return median if found["low"] == found["high"] else f"{median} ({spread_text(found)})"


def tables(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    results, columns = report["results"], report.get("columns")
    if columns:
        rows = {
            name: [full_text(found["columns"][column]) for column in columns]
            for name, found in results.items()
        }
    else:
        more = [
            (heading, key, text)
            for heading, key, text in (
                ("CPU time, µs/step", "cpu_us_per_step", number_text),
                ("cores used", "cores_used", "{:.2f}".format),
                (f"times {report.get('reference')}", "times", full_text),
            )
            if any(key in found for found in results.values())
        ]
        columns = [f"median, {report['unit']}", "lowest to highest", *(one for one, _, _ in more)]
        rows = {
            name: [number_text(found["median"]), spread_text(found)]
            + [text(found[key]) for _, key, text in more]
            for name, found in results.items()
        }
    lines = [f"| {' | '.join([report['title'], *columns])} |", f"|---{'|---:' * len(columns)}|"]
    lines += [f"| {' | '.join([name, *cells])} |" for name, cells in rows.items()]
    if report["targets"]:
        lines += ["", "| compared | ratio | lowest to highest | target | |"]
        lines += ["|---|---:|---:|---:|---|", *map(target_row, report["targets"])]
    lines += [f"\n{name}: {why}" for name, why in report["skipped"].items()]
    return "\n".join(lines)


def target_row(target: dict[str, Any]) -> str:
    """A target as a row of a table."""
    compared = f"{target['subject']} / {target['reference']}"
    bound = f"{'≤' if target['at_most'] else '≥'} {target['bound']:g}"
    met = "met" if target["met"] else "missed"
    ratio = number_text(target["median"])
    return f"| {compared} | {ratio} | {spread_text(target)} | {bound} | {met} |"


def machine_text(machine: dict[str, Any]) -> str:
    """Describe the machine in one sentence."""
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    return (
        f"{machine['date']}: {machine['cores']} cores ({machine['cpu']}), "
        f"{machine['memory_gib']} GiB, {machine['system']}, Python {machine['python']}; {versions}."
    )


# ---- the command line of every script


def parser_of(description: str | None, rounds: int, seconds: float) -> argparse.ArgumentParser:
    """Return a parser for every script."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=rounds, help="default: %(default)s")
    parser.add_argument(
        "--seconds", type=float, default=seconds,
        help="length of one contender's round (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--only", action="append", default=[], metavar="PART",
        help="run contenders whose name holds PART; may be given more than once",
    )  # fmt: skip
    parser.add_argument(
        "--beside", type=Path, metavar="CHECKOUT",
        help="measure contenders of this library with that of another checkout, too",
    )  # fmt: skip
    parser.add_argument("--json", type=Path, help="write the report here")
    return parser


def tell(report: dict[str, Any], given: argparse.Namespace) -> None:
    """Print a report, whose own tables go first, and write it down where that was asked for."""
    print(f"{report.get('tables') or tables(report)}\n\n{machine_text(report['machine'])}")
    if given.json:
        given.json.write_text(json.dumps(report, indent=1) + "\n")


def main(questions: Sequence[Question], description: str | None) -> None:
    """Parse the arguments, run the questions, print the report of all."""
    given = parser_of(description, questions[0].rounds, questions[0].seconds).parse_args()
    reports = [measure(question, given) for question in questions]
    tell(reports[0] if len(reports) == 1 else _joined(reports), given)


def _joined(reports: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the reports of several questions as one; their results are by title."""
    joined = {**reports[0], "skipped": {}}
    for report in reports:
        joined["machine"]["versions"] |= report["machine"]["versions"]
        joined["skipped"] |= report["skipped"]
    joined["results"] = {report["title"]: report["results"] for report in reports}
    joined["tables"] = "\n\n".join(tables(report) for report in reports if report["results"])
    return joined
