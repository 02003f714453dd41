"""Reads YAML files and OmegaConf nodes into plain Python values.

OmegaConf is imported only where a file is read: it takes a tenth of a second, and workers import
this package, too.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, cast

from rlightning_aio.config.problems import Problems
from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

TOP_LEVEL = ("envs", "env", "imports")
"""Sections of a file that are read."""


def plain(value: object, source: str) -> Any:
    """Return `value`, with an OmegaConf node turned into plain containers."""
    omegaconf = sys.modules.get("omegaconf")
    if omegaconf is None or not isinstance(value, omegaconf.Container):
        return value
    try:
        return omegaconf.OmegaConf.to_container(value, resolve=True, throw_on_missing=True)
    except omegaconf.errors.OmegaConfBaseException as error:
        raise ConfigError(f"{source}: {_first_line(error)}") from None


def sections(value: object, source: str) -> Any:
    """Return `value` as plain containers, with None for other sections of an OmegaConf document.

    Other sections are not resolved, because what they refer to may be missing here.
    """
    omegaconf = sys.modules.get("omegaconf")
    if omegaconf is None or not isinstance(value, omegaconf.DictConfig):
        return plain(value, source)
    document: Any = value
    if not {"env", "envs"} & document.keys():
        return plain(value, source)
    try:
        return {k: plain(document[k], source) if k in TOP_LEVEL else None for k in document}
    except omegaconf.errors.OmegaConfBaseException as error:
        raise ConfigError(f"{source}: {_first_line(error)}") from None


def imports_above(value: object, source: str) -> Any:
    """Return ``imports:`` of the document that contains the OmegaConf node `value`."""
    omegaconf = sys.modules.get("omegaconf")
    if omegaconf is None or not isinstance(value, omegaconf.Container):
        return ()
    node: Any = value
    while (node := node._get_parent()) is not None:  # noqa: SLF001
        if isinstance(node, omegaconf.DictConfig) and "imports" in node:
            return plain(node["imports"], source)
    return ()


def _first_line(error: Exception) -> str:
    where = getattr(error, "full_key", None)
    text = str(error).partition("\n")[0]
    return f"{where}: {text}" if where else text


def read_yaml(source: str, overrides: Sequence[str]) -> Any:
    """Read a YAML file and apply overrides to it.

    Raises:
        ConfigError: the file can't be read, or an override fits nothing.
    """
    import yaml  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415
    from omegaconf.errors import OmegaConfBaseException  # noqa: PLC0415

    try:
        document = OmegaConf.load(source)
    except yaml.YAMLError as error:
        raise ConfigError(f"{source}: {_not_yaml(error)}") from None
    except OmegaConfBaseException as error:
        raise ConfigError(f"{source}: {_first_line(error)}") from None
    except OSError as error:
        # OmegaConf itself raises one, without errno, for a file that holds a bare value.
        reason = error.strerror or "should hold envs: and a list of entries"
        raise ConfigError(f"{source}: {reason}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{source}: not a UTF-8 text file ({error.reason})") from None
    _override(document, source, overrides)
    return document


def _not_yaml(error: Exception) -> str:
    mark = getattr(error, "problem_mark", None)
    problem = getattr(error, "problem", None) or str(error)
    where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
    return f"{where}not valid YAML: {problem}"


def _override(document: Any, source: str, overrides: Sequence[str]) -> None:
    problems = Problems(source)
    for override in overrides:
        if (problem := _apply(document, override)) is not None:
            problems.add(f"override {override!r}", problem)
    problems.raise_any()


def _apply(document: Any, override: str) -> str | None:
    """Apply one override in place. Return a description of what is wrong with it, or None."""
    import yaml  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415
    from omegaconf.errors import OmegaConfBaseException  # noqa: PLC0415

    key, equals, text = override.partition("=")
    top, dot, below = key.partition(".")
    if not equals or not (top in TOP_LEVEL or (OmegaConf.is_dict(document) and top in document)):
        return "should look like envs.0.num_workers=8"
    if top in ("env", "envs"):
        # Either name works, whichever of them the file uses.
        top = "env" if "env" in document and "envs" not in document else "envs"
    try:
        value = OmegaConf.to_container(OmegaConf.from_dotlist([f"value={text}"]), resolve=False)
        OmegaConf.update(document, top + dot + below, cast("dict[str, Any]", value)["value"])
    except yaml.YAMLError as error:
        return f"the value is {_not_yaml(error)}"
    except (OmegaConfBaseException, TypeError, ValueError) as error:
        return f"names nothing in the file ({_first_line(error)})"
    return None
