"""How large is the public interface? Names, members, arguments, fields, commands, options, extras.

A name is public if the `__all__` of a module below lists it, or if it is named below; those that
several modules list are counted once. Members are the public attributes that classes of this
package define, arguments those of their constructors and methods and of functions, without `self`.

    python benchmarks/interface.py
    python benchmarks/interface.py --names
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import sys
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import typer

from rlightning_aio.cli.app import app
from rlightning_aio.config import EnvConfig

MODULES: Final = {
    "": "the package", "sync": "blocking", "vector": "vector", "sb3": "vector",
    "collecting": "collecting", "normalize": "collecting", "evaluation": "evaluation",
    "attempts": "attempts",
    "policies": "evaluation", "plugins.openpi": "evaluation",
    "plugins.lerobot": "evaluation", "plugins.export": "evaluation",
    "remote": "remote",
    "errors": "errors", "spaces": "envs", "envs.fast_path": "envs",
    "registry": "envs", "legacy": "legacy",
}  # fmt: skip
"""Modules that the documentation imports names from, each with its row of the table."""
ONLY: Final = {"registry": ["Backend"], "envs.fast_path": ["FastPath"]}
"""Modules of which it imports these alone."""
PACKAGE: Final = "rlightning_aio"
PYDANTICS: Final = {"model_config", "model_post_init"}
"""Attributes that pydantic puts into the classes of its models."""


@dataclass
class Row:
    """Counts of one part of the interface."""

    names: list[str] = field(default_factory=list[str])
    members: list[str] = field(default_factory=list[str])
    arguments: int = 0


def inventory() -> dict[str, Row]:
    """Count the interface, row by row."""
    _stand_in_for_sb3()
    rows: dict[str, Row] = {}
    seen: list[Any] = []
    for suffix, part in MODULES.items():
        module = importlib.import_module(".".join(filter(None, (PACKAGE, suffix))))
        row = rows.setdefault(part, Row())
        for name in ONLY.get(suffix, module.__all__):
            value = getattr(module, name)
            if any(value is other for other in seen):
                continue
            seen.append(value)
            row.names.append(".".join(filter(None, (suffix, name))))
            _count(name, value, row)
    return rows


def _count(name: str, value: Any, row: Row) -> None:
    if inspect.isclass(value):
        own = [c for c in value.__mro__ if c.__module__.startswith(PACKAGE)]
        members = {m for c in own for m in (*vars(c), *vars(c).get("__annotations__", ()))}
        public = sorted(m for m in members if not m.startswith("_") and m not in PYDANTICS)
        row.members += [f"{name}.{member}" for member in public]
        methods = [inspect.getattr_static(value, member, None) for member in public]
        takes = value.__init__ if any("__init__" in vars(c) for c in own) else None
        row.arguments += sum(map(_arguments, [takes, *methods]))
    else:
        row.arguments += _arguments(value)


def _arguments(function: Any) -> int:
    function = getattr(function, "__func__", function)
    if not inspect.isfunction(function):
        return 0
    return len([p for p in inspect.signature(function).parameters if p not in ("self", "cls")])


def _stand_in_for_sb3() -> None:
    """Let `sb3` be imported where Stable-Baselines3 is not installed."""
    name = "stable_baselines3"
    try:
        importlib.import_module(name)
    except ImportError:
        for part in ("", ".common", ".common.vec_env", ".common.vec_env.base_vec_env"):
            sys.modules[name + part] = ModuleType(name + part)
        sys.modules[f"{name}.common.vec_env.base_vec_env"].VecEnv = object  # pyright: ignore[reportAttributeAccessIssue]


def commands() -> dict[str, list[str]]:
    """Return the options of each command."""
    group: Any = typer.main.get_command(app)
    return {
        name: [p.opts[-1] for p in command.params if p.param_type_name == "option"]
        for name, command in group.commands.items()
    }


def extras() -> list[str]:
    """Return the extras of the distribution."""
    text = (Path(__file__).parents[1] / "pyproject.toml").read_text()
    return sorted(tomllib.loads(text)["project"]["optional-dependencies"])


def sizes() -> dict[str, int]:
    """Return every count that the interface is held to."""
    rows = inventory().values()
    return {
        "names": sum(len(row.names) for row in rows),
        "members": sum(len(row.members) for row in rows),
        "arguments": sum(row.arguments for row in rows),
        "fields": len(EnvConfig.model_fields),
        "commands": len(commands()),
        "options": len(set().union(*commands().values())),
        "extras": len(extras()),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--names", action="store_true", help="list every name and member")
    args = parser.parse_args()
    for part, row in inventory().items():
        print(f"{part:12} {len(row.names):3} {len(row.members):4} {row.arguments:4}")
        if args.names:
            print("   ", *row.names, *row.members, sep="\n    ")
    print(*(f"{name} {count}" for name, count in sizes().items()), sep=", ")


if __name__ == "__main__":
    main()
