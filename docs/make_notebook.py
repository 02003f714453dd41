"""Make examples/tutorial.ipynb from docs/tutorial.md.

    python docs/make_notebook.py

Prose becomes Markdown, a program whose first line names a file is written to that file, and every
other program is a cell. A test checks that the notebook is current.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PAGE, NOTEBOOK = ROOT / "docs" / "tutorial.md", ROOT / "examples" / "tutorial.ipynb"


def notebook() -> dict[str, Any]:
    """The notebook, as its file holds it."""
    cells = [_cell("%pip install --quiet rlightning-aio[video]", code=True, tags=["install"])]
    for number, part in enumerate(
        re.split(r"^```python\n(.*?)^```\n", PAGE.read_text(), flags=re.MULTILINE | re.DOTALL)
    ):
        if number % 2:
            named = re.match(r"# (\w+\.py)\n", part)
            source = f"%%writefile {named[1]}\n{part[named.end() :]}" if named else part
            cells.append(_cell(source, code=True))
        else:
            # A notebook on its own has no pages beside it, so links to them are their words.
            cells.append(_cell(re.sub(r"\[([^]]+)\]\((?!http)[^)]+\)", r"\1", part)))
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {
        "nbformat": 4,
        "nbformat_minor": 5,
        "metadata": {"kernelspec": kernel, "language_info": {"name": "python"}},
        "cells": cells,
    }


def _cell(source: str, *, code: bool = False, tags: list[str] | None = None) -> dict[str, Any]:
    metadata = {"tags": tags} if tags else {}
    cell: dict[str, Any] = {"id": "", "metadata": metadata, "source": source.strip("\n")}
    if code:
        return {**cell, "cell_type": "code", "execution_count": None, "outputs": []}
    return {**cell, "cell_type": "markdown"}


def written() -> str:
    """The text of the notebook's file."""
    return json.dumps(notebook(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    NOTEBOOK.write_text(written())
