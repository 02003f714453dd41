"""Reads a configuration: a file or a Python value with entries, and what its entries share.

OmegaConf is imported only where a file is read: it takes a tenth of a second, and workers import
this package, too.
"""

from __future__ import annotations

import difflib
import itertools
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

from pydantic import ValidationError

from rlightning_aio.config.checks import Entry, check_entry, check_imports, check_names
from rlightning_aio.config.entry import EnvConfig, completed
from rlightning_aio.config.problems import Problems, as_text, explained, unknown_field
from rlightning_aio.errors import ConfigError

TOP_LEVEL = ("envs", "env", "imports")
"""Sections of a file that are read."""
_OF_ENTRIES = EnvConfig.model_fields.keys() - {"imports"}
"""Keys of an entry that a document of entries has not."""
_TYPO = 0.8
"""Similarity above which another section of a file counts as a misspelt name."""


def load_config(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> list[EnvConfig]:
    """Read a YAML file with ``envs:`` (or ``env:``) and, optionally, ``imports:``.

    Args:
        path: the file. Other sections, such as those of a whole experiment, are ignored; entries
            may refer to them (``${train.seed}``).
        overrides: ``key=value`` each, applied in order; keys are dotted from the top of the
            file (``envs.0.num_workers=8``), values are YAML. They can change other sections, too.

    Returns:
        The entries in order. Each entry's ``imports`` begin with those of the file.

    Raises:
        ConfigError: the file can't be read, an override fits nothing, or the content is wrong.
            The message lists every problem.
    """
    source = os.fspath(path)
    return _parse(_read_yaml(source, overrides), source)


def parse_configs(
    env_cfgs: object, fields: Mapping[str, Any] = MappingProxyType({})
) -> list[EnvConfig]:
    """Check entries that were written in Python.

    Args:
        env_cfgs: a task's name, a callable, an `EnvConfig`, a plain mapping of its fields, or an
            OmegaConf node of them; a list of these; or a mapping with ``envs:`` (or ``env:``) and
            ``imports:`` as in a file. A node that is part of a document gets that document's
            ``imports``.
        fields: of the one entry that a name or callables make; without `env_cfgs`, all of its
            fields.

    Raises:
        ConfigError: something is wrong; the message lists every problem.
    """
    return _parse(_with_fields(env_cfgs, fields), "environment configuration")


def _with_fields(env_cfgs: object, fields: Mapping[str, Any]) -> object:
    if not fields:
        return env_cfgs
    if env_cfgs is None:
        return fields
    several = isinstance(env_cfgs, list | tuple)
    tasks = cast("Sequence[Any]", env_cfgs) if several else (env_cfgs,)
    if not (isinstance(env_cfgs, str) or (tasks and all(map(callable, tasks)))):
        raise ConfigError(
            f"{', '.join(fields)}: fields can be added to a task's name or to callables; write "
            "them into the configs"
        )
    if "task" in fields:
        raise ConfigError("task: is given twice")
    return {"task": tuple(tasks) if several else env_cfgs, **fields}


def _parse(env_cfgs: object, source: str) -> list[EnvConfig]:
    problems = Problems(source)
    listed, imports = _split(env_cfgs, source, problems)
    imports = _shared_imports(imports, problems)
    entries: list[Entry] = []
    for place, given in listed:
        shared = (*imports, *_shared_imports(_imports_above(given, source), problems))
        entry = _read_entry(_plain(given, source), place, problems)
        if entry is not None:
            entry.config = _with_imports(entry.config, shared)
            entries.append(entry)
            check_entry(entry, problems)
    check_names(entries, problems)
    check_imports(entries, imports, problems)
    problems.raise_any()
    return [entry.config for entry in entries]


def _split(env_cfgs: object, source: str, problems: Problems) -> tuple[list[tuple[str, Any]], Any]:
    """Return the entries, each with its place, and the imports they share."""
    if isinstance(env_cfgs, EnvConfig | str) or callable(env_cfgs):
        return [("envs.0", env_cfgs)], ()
    document = _sections(env_cfgs, source)
    if not isinstance(document, Mapping):
        if isinstance(document, list | tuple):
            document = _entries_of_callables(cast("Sequence[Any]", document))
        return _listed(document, "envs", problems), _imports_above(env_cfgs, source)
    fields = cast("Mapping[Any, Any]", document)
    if not {"env", "envs"} & fields.keys():
        if _OF_ENTRIES & fields.keys():
            return [("envs.0", env_cfgs)], ()
        closeness = 0.0  # No key is known, so report each of them.
    else:
        closeness = _TYPO
    for name in fields:
        if name not in TOP_LEVEL and difflib.get_close_matches(
            str(name), TOP_LEVEL, cutoff=closeness
        ):
            problems.add(str(name), unknown_field(name, TOP_LEVEL))
    key = "envs" if "envs" in fields or "env" not in fields else "env"
    if {"env", "envs"} <= fields.keys():
        problems.add("env", "means the same as envs, which is given, too; keep one of them")
    listed = _listed(_plain(fields.get(key, ()), source), key, problems)
    return listed, _plain(fields.get("imports", ()), source)


def _listed(entries: object, key: str, problems: Problems) -> list[tuple[str, Any]]:
    text = as_text(entries)
    if isinstance(entries, Mapping):
        entry = cast("Mapping[Any, Any]", entries)
        if _OF_ENTRIES & entry.keys():
            return [(key, entry)]
    if not isinstance(entries, list | tuple):
        hint = "; load_config reads files" if isinstance(entries, Path) else ""
        problems.add(key, f"should be a list of entries, got {text}{hint}")
        return []
    if not entries:
        problems.add(key, "no entries; give at least one, with its task")
    found = cast("Sequence[Any]", entries)
    return [(f"{key}.{index}", entry) for index, entry in enumerate(found)]


def _entries_of_callables(listed: Sequence[Any]) -> list[Any]:
    """Return `listed`, with one entry in place of callables that follow one another."""
    entries: list[Any] = []
    for are_callable, group in itertools.groupby(listed, callable):
        values = list(group)
        entries += [{"task": tuple(values)}] if are_callable else values
    return entries


def _shared_imports(imports: object, problems: Problems) -> tuple[str, ...]:
    text = as_text(imports)
    modules = cast("Sequence[Any]", imports) if isinstance(imports, list | tuple) else (None,)
    if all(isinstance(module, str) for module in modules):
        return tuple(modules)
    problems.add("imports", f"should be a list of module names, got {text}")
    return ()


def _with_imports(config: EnvConfig, shared: tuple[str, ...]) -> EnvConfig:
    if not shared:
        return config
    return config.model_copy(update={"imports": tuple(dict.fromkeys((*shared, *config.imports)))})


def _read_entry(entry: object, place: str, problems: Problems) -> Entry | None:
    if isinstance(entry, EnvConfig):
        return Entry(f"{place} ({entry.name!r})", entry, set())
    if isinstance(entry, str) or callable(entry):
        entry = {"task": entry}
    if not isinstance(entry, Mapping):
        problems.add(place, f"should be a mapping of fields, got {as_text(entry)}")
        return None
    given = cast("Mapping[Any, Any]", entry)
    fields = completed({k: _plain(v, place) for k, v in given.items()})
    if isinstance(name := fields.get("name"), str) and name:
        place = f"{place} ({name!r})"
    try:
        return Entry(place, EnvConfig.model_validate(fields), set())
    except ValidationError as error:
        faults = error.errors(include_url=False)
    for path, text in explained(faults, fields, EnvConfig.model_fields):
        problems.add(f"{place}, {path}", text)
    faulty = {str(fault["loc"][0]) for fault in faults}
    right = {k: v for k, v in fields.items() if str(k) not in faulty}
    return Entry(place, EnvConfig.model_validate({"name": "?", "backend": "?"} | right), faulty)


# -- YAML files and OmegaConf nodes, as plain Python values --------------------------


def _plain(value: object, source: str) -> Any:
    """Return `value`, with an OmegaConf node turned into plain containers."""
    omegaconf = sys.modules.get("omegaconf")
    if omegaconf is None or not isinstance(value, omegaconf.Container):
        return value
    try:
        return omegaconf.OmegaConf.to_container(value, resolve=True, throw_on_missing=True)
    except omegaconf.errors.OmegaConfBaseException as error:
        raise ConfigError(f"{source}: {_first_line(error)}") from None


def _sections(value: object, source: str) -> Any:
    """Return `value` as plain containers, with None for other sections of an OmegaConf document.

    Other sections are not resolved, because what they refer to may be missing here.
    """
    omegaconf = sys.modules.get("omegaconf")
    if omegaconf is None or not isinstance(value, omegaconf.DictConfig):
        return _plain(value, source)
    document: Any = value
    if not {"env", "envs"} & document.keys():
        return _plain(value, source)
    try:
        return {k: _plain(document[k], source) if k in TOP_LEVEL else None for k in document}
    except omegaconf.errors.OmegaConfBaseException as error:
        raise ConfigError(f"{source}: {_first_line(error)}") from None


def _imports_above(value: object, source: str) -> Any:
    """Return ``imports:`` of the document that contains the OmegaConf node `value`."""
    omegaconf = sys.modules.get("omegaconf")
    if omegaconf is None or not isinstance(value, omegaconf.Container):
        return ()
    node: Any = value
    while (node := node._get_parent()) is not None:  # noqa: SLF001
        if isinstance(node, omegaconf.DictConfig) and "imports" in node:
            return _plain(node["imports"], source)
    return ()


def _first_line(error: Exception) -> str:
    where = getattr(error, "full_key", None)
    text = str(error).partition("\n")[0]
    return f"{where}: {text}" if where else text


def _read_yaml(source: str, overrides: Sequence[str]) -> Any:
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
