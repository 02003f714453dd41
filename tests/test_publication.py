"""What is prepared for publication agrees with the project: the recipe."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import yaml

import rlightning_aio

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# Names that differ on conda-forge, and what an extra of Gymnasium's brings.
CONDA_NAMES = {"mujoco": "mujoco-python"}
OF_EXTRAS = {"imageio", "packaging"}


def test_the_recipe_asks_for_what_the_project_asks_for() -> None:
    """The same version, and the same requirements with the same bounds."""
    recipe = yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text())
    assert recipe["context"]["version"] == rlightning_aio.__version__
    assert f">={recipe['context']['python_min']}" == PROJECT["requires-python"]
    wanted = set()
    for requirement in PROJECT["dependencies"]:
        name, bound = re.match(r"([\w-]+)(?:\[\w+\])?>=([\d.]+)", requirement).groups()
        wanted.add(f"{CONDA_NAMES.get(name, name)} >={bound}")
    run = {entry for entry in recipe["requirements"]["run"] if not re.match(r"python |__", entry)}
    assert {entry for entry in run if entry.split()[0] not in OF_EXTRAS} == wanted
