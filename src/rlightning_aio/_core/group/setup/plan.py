"""`Plan`: the checked arguments of `build_env_group`.

Rule: every error that can be found without starting a process is raised here.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from rlightning_aio.config import EnvConfig, check_installed, makers_of, parse_configs
from rlightning_aio.errors import ConfigError
from rlightning_aio.protocol.pickling import dumped_with_code
from rlightning_aio.registry import load, placement_of
from rlightning_aio.types import PolicyResponse, default_env_preprocess_fn

if TYPE_CHECKING:
    from rlightning_aio._core.hosts.base import Host, Wiring
    from rlightning_aio._core.hosts.messages import StartOrder
    from rlightning_aio.registry import Placement

PreprocessFn = Callable[[PolicyResponse], Any]


@dataclass(frozen=True)
class Plan:
    """The checked arguments of `build_env_group`."""

    configs: list[EnvConfig]
    preprocess_fns: list[list[PreprocessFn | None]]
    mixed_actions: bool
    zero_copy: bool


def plan_group(
    env_cfgs: Any,
    fields: Mapping[str, Any],
    preprocess_fn: PreprocessFn | Sequence[PreprocessFn | None] | None,
    *,
    mixed_actions: bool,
    zero_copy: bool,
) -> Plan:
    """Check the arguments of `build_env_group`.

    Raises:
        ConfigError: a config or a preprocess function can't be used.
    """
    configs = parse_configs(env_cfgs, fields)
    check_installed(configs)
    fns = _preprocess_fns(configs, preprocess_fn)
    for config, own in zip(configs, fns, strict=True):
        place = placement_for(config)
        if place.check:
            load(place.check)(config)
        host_class(config)
        if place.places and own[0] not in (None, default_env_preprocess_fn):
            warnings.warn(
                f"entry {config.name!r}: preprocess_fn is ignored for an {config.backend}; it "
                "runs at the client",
                stacklevel=3,
            )
        for make in _distinct(makers_of(config)):
            _check_sendable(config, "task", make)
    return Plan(configs, fns, mixed_actions, zero_copy)


def placement_for(config: EnvConfig) -> Placement:
    """Return the place of the envs of an entry."""
    return placement_of(config.backend, config.placement)


def host_class(config: EnvConfig) -> Callable[[int, int, StartOrder, Wiring], Host]:
    """The class of the hosts of an entry, which makes them of what `base.Host` says.

    Raises:
        ConfigError: a package that the placement needs is missing.
    """
    place = placement_for(config)
    try:
        return load(place.target)
    except ImportError as error:
        if not place.extra:
            raise
        raise ConfigError(
            f"entry {config.name!r}: placement {config.placement!r} needs a package that is not "
            f"installed ({error}): pip install 'rlightning-aio[{place.extra}]'"
        ) from error


def _preprocess_fns(
    configs: list[EnvConfig], given: PreprocessFn | Sequence[PreprocessFn | None] | None
) -> list[list[PreprocessFn | None]]:
    """The preprocess functions: for each entry, one for each of its envs."""
    counts = [config.num_workers for config in configs]
    if given is None or callable(given):
        chosen = [[given] * count for count in counts]
    elif len(given) == len(configs):
        chosen = [[fn] * count for fn, count in zip(given, counts, strict=True)]
    elif len(given) == sum(counts):
        remaining = iter(given)
        chosen = [[next(remaining) for _ in range(count)] for count in counts]
    else:
        raise ConfigError(
            f"{len(given)} preprocess functions for {len(configs)} entries with {sum(counts)} "
            "envs; give one, one for each entry, or one for each env"
        )
    for config, fns in zip(configs, chosen, strict=True):
        for fn in _distinct(tuple(fns)):
            if not callable(fn):
                raise ConfigError(
                    f"entry {config.name!r}: preprocess_fn must be callable, not "
                    f"{type(fn).__name__}"
                )
            _check_sendable(config, "preprocess_fn", fn)
    return chosen


def _distinct(fns: Any) -> list[Any]:
    """The different callables of a tuple, or the one given; they may be unhashable."""
    listed = cast("tuple[Any, ...]", fns if isinstance(fns, tuple) else (fns,))
    return list({id(fn): fn for fn in listed if fn is not None}.values())


def _check_sendable(config: EnvConfig, field: str, fn: Any) -> None:
    """Raise `ConfigError` if a function can't be sent to the workers of an entry."""
    if not placement_for(config).spreads:
        return
    try:
        dumped_with_code(fn)
    except Exception as error:
        name = getattr(fn, "__qualname__", repr(fn))
        raise ConfigError(
            f"entry {config.name!r}: {field} {name} can't be sent to a worker: "
            f"{error}{_culprit(fn)}"
        ) from error


def _culprit(fn: Any) -> str:
    """The part of an error message that names the captured variable that can't be pickled."""
    fn = inspect.unwrap(fn)
    cells = zip(
        getattr(getattr(fn, "__code__", None), "co_freevars", ()),
        getattr(fn, "__closure__", None) or (),
        strict=False,
    )
    for name, cell in cells:
        try:
            dumped_with_code(cell.cell_contents)
        except Exception:
            return f"; it captures {name!r}, which can't be pickled"
    return ""
