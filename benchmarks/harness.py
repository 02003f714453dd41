"""Alternating rounds of contenders in one run, and their reports.

Rule: contenders take turns (see `rlightning_aio.cli.measurement`), each in its own process, which
sleeps during the turns of others.
Left out on purpose: the work to measure, which is in the scripts, one question each.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import multiprocessing as mp
import os
import sys
import tempfile
import time
import traceback
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from rlightning_aio.cli.measurement import Figures, family, in_turns, machine_facts

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from multiprocessing.connection import Connection

# One math thread for each contender: none is faster with more, and some would
# start one for each core in each of their processes.
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
NAME_WIDTH = 34


class Contender:
    """One way to do the work; subclasses are dataclasses that can be pickled.

    Everything but the constructor runs in the contender's own process.
    """

    name: str

    @property
    def requires(self) -> tuple[str, ...]:
        """Return the modules without which it is left out."""
        return ()

    def setup(self) -> None:
        """Prepare the first round; called once, not measured."""

    def round(self, seconds: float) -> Any:
        """Run one round of about that length; return the measured figure.

        Any other value that can be pickled is for a script with its own report.
        """
        raise NotImplementedError

    def teardown(self) -> None:
        """Clean up after the last round; called once, also if a round has failed."""


@dataclass(frozen=True)
class Target:
    """A bound for `subject` in comparison to `reference`, both contenders' names.

    Attributes:
        bound: of the ratio (or difference) of their figures in the same round.
        at_most: the bound is an upper one.
        difference: compare by difference, not by ratio.
    """

    subject: str
    reference: str
    bound: float
    at_most: bool = False
    difference: bool = False

    def is_met(self, value: float) -> bool:
        return value <= self.bound if self.at_most else value >= self.bound


@dataclass(frozen=True)
class Question:
    """The question that a script answers.

    Attributes:
        name: of the result files.
        title: one line, with the workload.
        unit: of the contenders' figures.
        seconds: length of a round; None where the work itself gives the length.
        counts_steps: the figures are env steps per second, so processor time can be reported by
            env step, too.
        batch: the number of env steps in a batch, for context switches by batch; None if they are
            not reported.
    """

    name: str
    title: str
    unit: str
    contenders: Sequence[Contender]
    targets: Sequence[Target] = ()
    rounds: int = 7
    seconds: float | None = 1.5
    counts_steps: bool = True
    batch: int | None = None


class Load(NamedTuple):
    """What all processes of a contender asked of the machine in a round.

    Attributes:
        cores: number of processors that they kept busy. If it is well below the possible number,
            the contender waited, for others or for itself.
        switches: context switches per second.
    """

    cores: float
    switches: float


def load_by_step(
    rates: Sequence[float], loads: Sequence[Load], batch: int | None
) -> dict[str, float]:
    """Return the processor time of all processes for a step, the number of busy processors, and the
    context switches for a batch of `batch` steps.
    """
    pairs = list(zip(loads, rates, strict=True))
    found = {
        "cpu_us_per_step": Figures([1e6 * load.cores / rate for load, rate in pairs]),
        "cores_used": Figures([load.cores for load in loads]),
    }
    if batch is not None:
        switches = [batch * load.switches / rate for load, rate in pairs]
        found["switches_per_batch"] = Figures(switches)
    return {name: figures.median for name, figures in found.items()}


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


class Stage:
    """A contender's process."""

    def __init__(self, contender: Contender) -> None:
        self.contender = contender

    def __enter__(self) -> Self:
        context = mp.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_perform, args=(theirs, self.contender))
        self._process.start()
        theirs.close()
        self._answer()
        return self

    def round(self, seconds: float) -> tuple[Any, Load]:
        """Run a round; return its value, and what it asked of the machine."""
        before, began = self._used(), time.perf_counter()
        self._connection.send(seconds)
        value = self._answer()
        wall = time.perf_counter() - began
        busy, switches = (
            after - earlier for after, earlier in zip(self._used(), before, strict=True)
        )
        return value, Load(busy / wall, switches / wall)

    def _used(self) -> tuple[float, int]:
        """Return the seconds of processor time and the context switches of the contender's
        processes so far.
        """
        assert self._process.pid is not None
        threads = [
            t for pid in family(self._process.pid) for t in Path(f"/proc/{pid}/task").glob("*")
        ]
        return sum(map(_busy_ns, threads)) / 1e9, sum(map(_switches, threads))

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


def _busy_ns(thread: Path) -> int:
    try:
        return int(thread.joinpath("schedstat").read_text().split()[0])
    except (FileNotFoundError, ProcessLookupError):
        return 0


def _switches(thread: Path) -> int:
    try:
        lines = thread.joinpath("status").read_text().splitlines()
    except (FileNotFoundError, ProcessLookupError):
        return 0
    return sum(int(line.split()[1]) for line in lines if "ctxt_switches" in line)


class ContenderFailed(Exception):
    """A contender raised or died; the text has the reason."""


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


def missing(contender: Contender) -> list[str]:
    """Return the modules that the contender needs and that aren't installed."""
    return [name for name in contender.requires if importlib.util.find_spec(name) is None]


def measure(question: Question, rounds: int, seconds: float, only: Sequence[str]) -> dict[str, Any]:
    """Run a question; return its report as plain data."""
    machine = machine_facts(modules_of(question.contenders))
    turns, skipped = take_turns(question.contenders, rounds, seconds, only)
    figures = {name: Figures([value for value, _ in found]) for name, found in turns.items()}
    return {
        "name": question.name,
        "title": question.title,
        "unit": question.unit,
        "rounds": rounds,
        "seconds": question.seconds and seconds,
        "machine": machine,
        "results": {
            name: found.as_json()
            | (
                load_by_step(found.values, [load for _, load in turns[name]], question.batch)
                if question.counts_steps
                else {}
            )
            for name, found in figures.items()
        },
        "targets": [
            _judged(target, figures)
            for target in question.targets
            if {target.subject, target.reference} <= figures.keys()
        ],
        "skipped": skipped,
    }


def take_turns(
    contenders: Sequence[Contender],
    rounds: int,
    seconds: float,
    only: Sequence[str],
    text_of: Callable[[Any], str] | None = None,
) -> tuple[dict[str, list[tuple[Any, Load]]], dict[str, str]]:
    """Let contenders take turns, each in its own process.

    Args:
        contenders: in the order of their turns.
        rounds: number of turns of each.
        seconds: about the length of a turn.
        only: parts of the names of those that take part; all if empty.
        text_of: returns the value of a round as text.

    Returns the values and loads of each contender's rounds, and the reasons why others were left
    out.
    """
    found: dict[str, list[tuple[Any, Load]]] = {}
    skipped: dict[str, str] = {}
    with ExitStack() as stack:
        stages = _stages(contenders, only, stack, skipped)
        for number, stage in in_turns(stages, rounds):
            name = stage.contender.name
            try:
                value, load = stage.round(seconds)
            except ContenderFailed as error:
                stages.remove(stage)
                found.pop(name, None)
                skipped[name] = _last_line(name, error)
                continue
            found.setdefault(name, []).append((value, load))
            text = (text_of or number_text)(value)
            say(f"  round {number + 1}/{rounds}  {name:{NAME_WIDTH}} {text}")
    return found, skipped


def _stages(
    contenders: Sequence[Contender],
    only: Sequence[str],
    stack: ExitStack,
    skipped: dict[str, str],
) -> list[Stage]:
    stages: list[Stage] = []
    for contender in contenders:
        if only and not any(part in contender.name for part in only):
            continue
        if lacking := missing(contender):
            skipped[contender.name] = f"needs {', '.join(lacking)}"
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
    subject, reference = figures[target.subject], figures[target.reference]
    found = subject.minus(reference) if target.difference else subject.over(reference)
    return {**asdict(target), **found.as_json(), "met": target.is_met(found.median)}


def modules_of(contenders: Iterable[Contender]) -> set[str]:
    """Return the modules that any of them needs."""
    return {name for contender in contenders for name in contender.requires}


# ---- reports


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def number_text(value: float) -> str:
    """Format a number with three significant digits and thousands separators."""
    if abs(value) >= 1000:
        digits = len(str(int(abs(value)))) - 3
        return f"{round(value, -digits):,.0f}"
    return f"{value:.3g}"


JUDGED = ("| compared | median | lowest to highest | target | |", "|---|---:|---:|---:|---|")
"""The head of a table of targets."""


def tables(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    results = report["results"]
    more = [
        (heading, name, text)
        for heading, name, text in (
            ("CPU time, µs/step", "cpu_us_per_step", number_text),
            ("cores used", "cores_used", "{:.2f}".format),
            ("context switches/batch", "switches_per_batch", number_text),
        )
        if any(name in found for found in results.values())
    ]
    lines = [
        f"| {report['title']} | median, {report['unit']} | lowest to highest |"
        + "".join(f" {heading} |" for heading, _, _ in more),
        "|---|---:|---:|" + "---:|" * len(more),
    ]
    for name, found in results.items():
        spread = f"{number_text(found['low'])} to {number_text(found['high'])}"
        row = f"| {name} | {number_text(found['median'])} | {spread} |"
        lines.append(row + "".join(f" {text(found[key])} |" for _, key, text in more))
    if report["targets"]:
        lines += ["", *JUDGED]
        lines += [target_row(target, report["unit"]) for target in report["targets"]]
    lines += [f"\n{name}: {why}" for name, why in report["skipped"].items()]
    return "\n".join(lines)


def target_row(target: dict[str, Any], unit: str) -> str:
    """A target as a row of a table."""
    sign, suffix = ("minus", f" {unit}") if target["difference"] else ("/", "")
    bound = f"{'≤' if target['at_most'] else '≥'} {target['bound']:g}{suffix}"
    compared = f"{target['subject']} {sign} {target['reference']}"
    return judged_row(compared, Figures(target["values"]), bound, met=target["met"])


def judged_row(compared: str, found: Figures, bound: str, *, met: bool) -> str:
    """Figures and their bound as a row of a table."""
    spread = f"{number_text(min(found.values))} to {number_text(max(found.values))}"
    cells = (compared, number_text(found.median), spread, bound, "met" if met else "missed")
    return f"| {' | '.join(cells)} |"


def machine_text(machine: dict[str, Any]) -> str:
    """Describe the machine in one sentence."""
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    when = f"{machine['date']}: " if "date" in machine else "An earlier version: "
    return (
        f"{when}{machine['cores']} cores ({machine['cpu']}), {machine['memory_gib']} GiB, "
        f"{machine['system']}, Python {machine['python']}; {versions}."
    )


def plot(report: dict[str, Any], path: Path) -> None:
    """Plot a bar for each contender's median, and a dot for each round."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    results = report["results"]
    figure, axes = plt.subplots(figsize=(7.5, 0.9 + 0.38 * len(results)), layout="constrained")
    for place, (name, found) in enumerate(results.items()):
        color = "tab:blue" if name.startswith("rlightning") else "tab:gray"
        axes.barh(place, found["median"], color=color, alpha=0.6)
        axes.plot(found["values"], [place] * len(found["values"]), ".", color="black", markersize=4)
    axes.set_yticks(range(len(results)), list(results))
    axes.invert_yaxis()
    axes.set_xlim(left=0)
    axes.set_xlabel(report["unit"])
    axes.set_title(report["title"], fontsize=10, loc="left")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=80)
    plt.close(figure)


# ---- the command line of every script


def arguments(description: str | None, rounds: int, seconds: float | None) -> argparse.Namespace:
    """Return a parser for every script; `seconds` is None if the work defines a round's length.

    Math libraries are kept to one thread from here on.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=rounds, help="default: %(default)s")
    if seconds is not None:
        parser.add_argument(
            "--seconds", type=float, default=seconds,
            help="length of one contender's round (default: %(default)s)",
        )  # fmt: skip
    parser.add_argument(
        "--only", action="append", default=[], metavar="PART",
        help="run contenders whose name holds PART; may be given more than once",
    )  # fmt: skip
    parser.add_argument("--json", type=Path, help="write the report here")
    parser.add_argument("--plot", type=Path, help="draw the report here (needs matplotlib)")
    given = parser.parse_args()
    if given.plot and importlib.util.find_spec("matplotlib") is None:
        parser.error("--plot needs matplotlib: pip install matplotlib")
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    return given


def main(question: Question, description: str | None) -> None:
    """Parse the arguments, run the question, print the report."""
    given = arguments(description, question.rounds, question.seconds)
    report = measure(question, given.rounds, getattr(given, "seconds", 0.0), given.only)
    print(f"{tables(report)}\n\n{machine_text(report['machine'])}")
    if given.json:
        given.json.write_text(json.dumps(report, indent=1) + "\n")
    if given.plot:
        plot(report, given.plot)
