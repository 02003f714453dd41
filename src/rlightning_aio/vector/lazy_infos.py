"""`LazyInfos`: a list of infos that is made when somebody reads it.

Most programs read an info only at the end of an episode, and decoding those of all envs costs more
than anything else in a step. The first call of any method makes the list; before that, the object
holds only what makes it. Left out: laziness by env, which would need dicts that are no plain dicts.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["LazyInfos"]

_READING_OR_CHANGING: Final = (
    "__add__", "__contains__", "__delitem__", "__eq__", "__ge__", "__getitem__", "__gt__",
    "__iadd__", "__imul__", "__iter__", "__le__", "__len__", "__lt__", "__mul__", "__ne__",
    "__repr__", "__reversed__", "__rmul__", "__setitem__", "append", "clear", "copy", "count",
    "extend", "index", "insert", "pop", "remove", "reverse", "sort",
)  # fmt: skip


class LazyInfos(list[dict[str, Any]]):
    """A list that is made by the first call of any of its methods.

    Args:
        make: returns the elements; called at most once.
    """

    __slots__ = ("_make",)

    # Mutable, as any list.
    __hash__ = None  # pyright: ignore[reportAssignmentType]

    def __init__(self, make: Callable[[], list[dict[str, Any]]]) -> None:
        super().__init__()
        self._make: Callable[[], list[dict[str, Any]]] | None = make

    def fill(self) -> None:
        """Make the elements, unless that has been done."""
        make, self._make = self._make, None
        if make is not None:
            super().extend(make())

    def __radd__(self, other: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Concatenate; a plain list's own method would read the elements past this class."""
        return other + list(self)

    def __reduce_ex__(self, protocol: object) -> tuple[Any, ...]:
        """Pickle and copy as a plain list."""
        return list, (list(self),)


def _filling(name: str) -> Callable[..., Any]:
    method = getattr(list, name)

    @functools.wraps(method)
    def call(infos: LazyInfos, *args: Any, **kwargs: Any) -> Any:
        infos.fill()
        return method(infos, *args, **kwargs)

    return call


for _name in _READING_OR_CHANGING:
    setattr(LazyInfos, _name, _filling(_name))
