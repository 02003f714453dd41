"""The programs of the pages on libraries that `make test` does not install run as they stand."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest
from run_python import output_of

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.simulators
@pytest.mark.parametrize(
    ("page", "needed"),
    [
        ("torchrl", ["torchrl"]),
        ("rllib", ["ray", "tree", "torch"]),
        ("stable_baselines3", ["stable_baselines3"]),
    ],
)
def test_program_runs(
    page: str, needed: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To its end, and prints what it says."""
    # Ray would join a cluster that happens to be there, of other tests, say.
    monkeypatch.setenv("RAY_ADDRESS", "local")
    if missing := [name for name in needed if importlib.util.find_spec(name) is None]:
        pytest.skip(f"{', '.join(missing)} not installed")
    text = (DOCS / f"{page}.md").read_text()
    (block,) = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    program = tmp_path / "program.py"
    program.write_text(block)
    assert output_of(program, folder=tmp_path).strip()
