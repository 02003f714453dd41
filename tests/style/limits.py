"""Check the sizes of `src`: functions, classes, constructors and modules stay readable.

`make check` runs it. A function's lines include its signature and docstring. Its branches are
conditions, loops, comprehensions and handlers, those of inner functions excluded. Constructors are
`__init__`: the fields of a dataclass, a named tuple or a struct are no arguments.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).parents[2]
SRC = ROOT / "src"

LIMITS: Final = {
    "lines of a function": 60,
    "branches of a function": 12,
    "methods of a class": 30,
    "arguments of a constructor": 7,
    "lines of a module": 600,
}

EXCEPTIONS: Final[dict[tuple[str, str], str]] = {
    ("rlightning_aio.batch.data.BatchedData", "methods of a class"): (
        "Half of them are columns of results, one property each."
    ),
    ("rlightning_aio.remote.client.RemoteEnvClient", "arguments of a constructor"): (
        "Each is a setting of its own of one connection."
    ),
    ("rlightning_aio.vector.env.VectorEnv", "arguments of a constructor"): (
        "It takes those of Gymnasium's AsyncVectorEnv, so that programs change only an import."
    ),
}
"""By qualified name and limit: why it is exceeded. An exception that is not needed is refused."""

FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
BRANCHES = (
    ast.If,
    ast.IfExp,
    ast.For,
    ast.AsyncFor,
    ast.While,
    ast.ExceptHandler,
    ast.comprehension,
    ast.match_case,
)


class Count(NamedTuple):
    """How much of something a definition has."""

    path: Path
    line: int
    name: str
    limit: str
    count: int


def counts() -> Iterator[Count]:
    for path in sorted(SRC.rglob("*.py")):
        text = path.read_text()
        module = ".".join(path.relative_to(SRC).with_suffix("").parts)
        yield Count(path, 1, module, "lines of a module", len(text.splitlines()))
        yield from counts_in(ast.parse(text), path, module)


def counts_in(scope: ast.AST, path: Path, outer: str) -> Iterator[Count]:
    for node in ast.iter_child_nodes(scope):
        if isinstance(node, FUNCTIONS):
            name = f"{outer}.{node.name}"
            assert node.end_lineno is not None
            lines = node.end_lineno - node.lineno + 1
            yield Count(path, node.lineno, name, "lines of a function", lines)
            yield Count(path, node.lineno, name, "branches of a function", branches(node))
            yield from counts_in(node, path, name)
        elif isinstance(node, ast.ClassDef):
            name = f"{outer}.{node.name}"
            methods = [item for item in node.body if isinstance(item, FUNCTIONS)]
            num_methods = sum(not is_overload(item) for item in methods)
            yield Count(path, node.lineno, name, "methods of a class", num_methods)
            num_arguments = max(map(arguments, methods), default=0)
            yield Count(path, node.lineno, name, "arguments of a constructor", num_arguments)
            yield from counts_in(node, path, name)
        else:
            yield from counts_in(node, path, outer)


def branches(function: ast.AST) -> int:
    """Number of conditions, loops and handlers of `function`, without those of inner functions."""
    number = 0
    for node in ast.iter_child_nodes(function):
        if isinstance(node, (*FUNCTIONS, ast.ClassDef)):
            continue
        number += isinstance(node, BRANCHES) + branches(node)
    return number


def arguments(method: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Number of arguments of a constructor, `self` excluded; 0 for another method."""
    if method.name != "__init__":
        return 0
    given = method.args
    named = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    return len(named) - 1 + bool(given.vararg) + bool(given.kwarg)


def is_overload(method: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return any("overload" in ast.unparse(decorator) for decorator in method.decorator_list)


def main() -> int:
    excess = [count for count in counts() if count.count > LIMITS[count.limit]]
    found = {(count.name, count.limit) for count in excess}
    refused = [count for count in excess if (count.name, count.limit) not in EXCEPTIONS]
    for path, line, name, limit, number in refused:
        place = f"{path.relative_to(ROOT)}:{line}"
        print(f"{place}: {name}: {number} {limit}, at most {LIMITS[limit]}")
    needless = [key for key in EXCEPTIONS if key not in found]
    for name, limit in needless:
        print(f"{name} is within the limit of {limit}: remove its exception")
    print(f"{len(refused)} sizes above a limit; {len(EXCEPTIONS)} exceptions with a reason")
    return 1 if refused or needless else 0


if __name__ == "__main__":
    sys.exit(main())
