"""The tutorial's programs run as the page tells, a kill included; its notebook is current."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

from run_python import blocks, output_of

ROOT = Path(__file__).parents[2]


def test_programs_of_the_tutorial_run(tmp_path: Path) -> None:
    """Training is killed and resumed; the policy that results is better than chance."""
    page = (ROOT / "docs" / "tutorial.md").read_text()
    outputs = []
    for number, block in enumerate(blocks("python", page)):
        named = re.match(r"# (\w+\.py)\n", block)
        program = tmp_path / (named[1] if named else f"program_{number}.py")
        program.write_text(block)
        if not named:
            outputs.append(output_of(program, folder=tmp_path, asyncio_debug=False))
    trained, evaluated = outputs
    killed = re.search(r"killed after update (\d+)", trained)
    continued = re.search(r"continues after update (\d+)", trained)
    assert killed
    assert continued
    assert 10 <= int(killed[1]) <= int(continued[1]) < 30
    success = re.search(r"success (\d+)%", evaluated)
    assert success
    assert int(success[1]) > 12
    assert "reach-0-episode-0.mp4" in evaluated


def test_the_notebook_is_current() -> None:
    """It is what `python docs/make_notebook.py` makes of the page."""
    made = runpy.run_path(str(ROOT / "docs" / "make_notebook.py"))["written"]()
    assert (ROOT / "examples" / "tutorial.ipynb").read_text() == made
