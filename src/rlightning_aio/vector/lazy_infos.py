"""`LazyInfos` and `LazyColumns`: infos that are made when somebody reads them.

Most programs read an info only at the end of an episode, and making those of all envs costs more
than anything else in a step. The first call of any method makes them; before that, the object
holds only what makes them. Left out: laziness by env, which would need dicts that are no plain
dicts.
"""

from __future__ import annotations

import functools
import threading
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable

_OF_BOTH: Final = (
    "__contains__", "__delitem__", "__eq__", "__ge__", "__getitem__", "__gt__", "__iter__",
    "__le__", "__len__", "__lt__", "__ne__", "__repr__", "__reversed__", "__setitem__", "clear",
    "copy", "pop",
)  # fmt: skip
_OF_LISTS: Final = (
    "__add__", "__iadd__", "__imul__", "__mul__", "__rmul__", "append", "count", "extend", "index",
    "insert", "remove", "reverse", "sort",
)  # fmt: skip
_OF_DICTS: Final = (
    "__ior__", "__or__", "__ror__", "get", "items", "keys", "popitem", "setdefault", "update",
    "values",
)  # fmt: skip

_MAKING: Final = threading.RLock()
"""Held while infos are made, so that another thread that reads them waits until they are there."""


class LazyInfos(list[dict[str, Any]]):
    """A list that is made by the first call of any of its methods.

    Args:
        make: returns the elements; called once, and again after an error.
    """

    __slots__ = ("_make",)

    # Mutable, as any list.
    __hash__ = None  # pyright: ignore[reportAssignmentType]

    def __init__(self, make: Callable[[], list[dict[str, Any]]]) -> None:
        super().__init__()
        self._make: Callable[[], list[dict[str, Any]]] | None = make

    def fill(self) -> None:
        """Make the elements, unless that has been done."""
        if self._make is None:
            return
        with _MAKING:
            if self._make is not None:
                super().extend(self._make())
                self._make = None

    def __radd__(self, other: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Concatenate; a plain list's own method would read the elements past this class."""
        return other + list(self)

    def __reduce_ex__(self, protocol: object) -> tuple[Any, ...]:
        """Pickle and copy as a plain list."""
        return list, (list(self),)


class LazyColumns(dict[str, Any]):
    """A dict that is made by the first call of any of its methods.

    Left out: `json.dumps`, which looks into a dict past its methods, and can't write arrays anyway.

    Args:
        make: returns the entries; called once, and again after an error.
        make_each: returns the infos of the single envs, without making the columns.
    """

    __slots__ = ("_make", "_make_each")

    # Mutable, as any dict.
    __hash__ = None  # pyright: ignore[reportAssignmentType]

    def __init__(
        self,
        make: Callable[[], dict[str, Any]],
        make_each: Callable[[], list[dict[str, Any]]] | None = None,
    ) -> None:
        super().__init__()
        self._make: Callable[[], dict[str, Any]] | None = make
        self._make_each = make_each

    def each(self) -> list[dict[str, Any]] | None:
        """Return the infos of the single envs; None if only the columns say what they are now."""
        return None if self._make is None or self._make_each is None else self._make_each()

    def fill(self) -> None:
        """Make the entries, unless that has been done."""
        if self._make is None:
            return
        with _MAKING:
            if self._make is not None:
                super().update(self._make())
                self._make = None

    def __reduce_ex__(self, protocol: object) -> tuple[Any, ...]:
        """Pickle and copy as a plain dict."""
        return dict, (dict(self),)


def _filling(kind: type[Any], name: str) -> Callable[..., Any]:
    method = getattr(kind, name)

    @functools.wraps(method)
    def call(infos: Any, *args: Any, **kwargs: Any) -> Any:
        infos.fill()
        return method(infos, *args, **kwargs)

    return call


for _name in (*_OF_BOTH, *_OF_LISTS):
    setattr(LazyInfos, _name, _filling(list, _name))
for _name in (*_OF_BOTH, *_OF_DICTS):
    setattr(LazyColumns, _name, _filling(dict, _name))
