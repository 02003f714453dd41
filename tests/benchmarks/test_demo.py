"""What `make run` shows."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
from pathlib import Path

from patience import HANG
from run_python import output_of

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "benchmarks" / "demo.py"


LINES = ("CartPole", "HalfCheetah, batched", "own env of 200 µs", "own env that waits")


def test_it_shows_four_lines_and_the_next_steps(tmp_path: Path) -> None:
    """Each with the rates of all three, and how many times as fast ours is as each of theirs."""
    shown = output_of(DEMO, "--rounds", "1", "--seconds", "0.1", folder=tmp_path)
    for line in LINES:
        number = r"([\d,.]+)"  # Below 100 it has a decimal.
        found = re.search(rf"{line} +{number} +{number} +{number} +([\d.]+) and ([\d.]+)", shown)
        assert found, (line, shown)
        *theirs, ours, once, twice = (float(one.replace(",", "")) for one in found.groups())
        for rate, ratio in zip(theirs, (once, twice), strict=True):
            # Rates are shown with three digits, and so are ratios from 10 on.
            assert abs(ratio - ours / rate) <= (0.5 if ratio >= 10 else 0.05) + 0.01 * ours / rate
    assert "CartPole is no faster" in shown
    for page in re.findall(r"(?:docs|examples)/\w+\.\w+", shown):
        assert (ROOT / page).exists(), page


def test_ctrl_c_ends_it_with_what_was_measured(tmp_path: Path) -> None:
    """On a terminal, where all processes get the signal."""
    terminal, theirs = pty.openpty()
    with subprocess.Popen(
        [sys.executable, DEMO, "--rounds", "1000000", "--seconds", "0.05"],
        cwd=tmp_path,
        env={**os.environ, "COLUMNS": "100", "TERM": "xterm"},
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        start_new_session=True,
    ) as process:
        os.close(theirs)
        shown = b""
        while not re.search(rb"CartPole\D*[\d,]+ +[\d,]+ +[\d,]+ +[\d.]+", shown):
            shown += os.read(terminal, 10_000)
        os.killpg(process.pid, signal.SIGINT)
        try:
            while part := os.read(terminal, 10_000):
                shown += part
        except OSError:  # The last process has closed the terminal.
            pass
        assert process.wait(HANG) == 130
    os.close(terminal)
    text = shown.decode()
    assert "Traceback" not in text
    assert "Next:" in text
