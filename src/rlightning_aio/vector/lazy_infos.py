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

_READS_NOTHING: Final = {
    "__class_getitem__", "__doc__", "__getattribute__", "__hash__", "__init__", "__new__",
    "__sizeof__", "fromkeys",
}  # fmt: skip
"""Of a list or a dict; all else that they define reads or changes what they hold."""

_MAKING: Final = threading.RLock()
"""Held while infos are made, so that another thread that reads them waits until they are there."""


class _Lazy:
    """What is made by the first call of any of its methods."""

    __slots__ = ()

    _kind: Any  # A list or a dict.
    _make: Callable[[], Any] | None

    def fill(self) -> None:
        """Make what it holds, unless that has been done."""
        if self._make is None:
            return
        with _MAKING:
            if self._make is not None:
                self._kind.__init__(self, self._make())
                self._make = None

    def __reduce_ex__(self, protocol: object) -> tuple[Any, ...]:
        """Pickle and copy as a plain list or dict."""
        return self._kind, (self._kind(self),)


class LazyInfos(_Lazy, list[dict[str, Any]]):
    """A list that is made by the first call of any of its methods.

    Args:
        make: returns the elements; called once, and again after an error.
    """

    __slots__ = ("_make",)

    _kind = list

    def __init__(self, make: Callable[[], list[dict[str, Any]]]) -> None:
        super().__init__()
        self._make = make

    def __radd__(self, other: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Concatenate; a plain list's own method would read the elements past this class."""
        return other + list(self)


class LazyColumns(_Lazy, dict[str, Any]):
    """A dict that is made by the first call of any of its methods.

    Left out: `json.dumps`, which looks into a dict past its methods, and can't write arrays anyway.

    Args:
        make: returns the entries; called once, and again after an error.
        make_each: returns the infos of the single envs, without making the columns.
    """

    __slots__ = ("_make", "_make_each")

    _kind = dict

    def __init__(
        self,
        make: Callable[[], dict[str, Any]],
        make_each: Callable[[], list[dict[str, Any]]] | None = None,
    ) -> None:
        super().__init__()
        self._make = make
        self._make_each = make_each

    def each(self) -> list[dict[str, Any]] | None:
        """Return the infos of the single envs; None if only the columns say what they are now."""
        return None if self._make is None or self._make_each is None else self._make_each()


def _filling(kind: type[Any], name: str) -> Callable[..., Any]:
    method = getattr(kind, name)

    @functools.wraps(method)
    def call(infos: Any, *args: Any, **kwargs: Any) -> Any:
        infos.fill()
        return method(infos, *args, **kwargs)

    return call


for _lazy, _plain in ((LazyInfos, list), (LazyColumns, dict)):
    for _name in vars(_plain).keys() - _READS_NOTHING:
        setattr(_lazy, _name, _filling(_plain, _name))
