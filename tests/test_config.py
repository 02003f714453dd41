"""Configurations: accepted forms, and messages for wrong ones."""

from __future__ import annotations

import json
import math
import pickle
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import hypothesis.strategies as st
import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings
from omegaconf import OmegaConf

from rlightning_aio import build_env_group
from rlightning_aio.config import (
    EnvConfig,
    check_installed,
    load_config,
    moved,
    parse_configs,
)
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import BACKENDS, PLACEMENTS, Backend, placement_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    Write = Callable[[object], Path]

CONFIGS = Path(__file__).parents[1] / "configs"
HOPPER: dict[str, Any] = {"name": "hopper", "backend": "mujoco", "task": "Hopper-v5"}
CARTPOLE: dict[str, Any] = {"name": "cartpole", "backend": "gymnasium", "task": "CartPole-v1"}


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Return a function that writes a document, or its text, to a file."""

    def write(document: object) -> Path:
        path = tmp_path / "config.yaml"
        path.write_text(document if isinstance(document, str) else yaml.safe_dump(document))
        return path

    return write


def problems_of(cfgs: object) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_configs(cfgs)
    return str(caught.value)


# ---- accepted configurations


@pytest.mark.parametrize(
    "wrap",
    [
        lambda fields: fields,
        lambda fields: [fields],
        lambda fields: (fields,),
        lambda fields: EnvConfig(**fields),
        lambda fields: [EnvConfig(**fields)],
        lambda fields: {"envs": [fields]},
        lambda fields: {"env": [EnvConfig(**fields)]},
        OmegaConf.create,
        lambda fields: OmegaConf.create([fields]),
        lambda fields: [OmegaConf.create(fields)],
        lambda fields: OmegaConf.create({"envs": [fields]}).envs,
        lambda fields: OmegaConf.create({"env": [fields]}),
        lambda fields: dict(OmegaConf.create(fields).items()),
    ],
)
def test_every_form_of_an_entry_means_the_same(wrap: Callable[[Any], object]) -> None:
    """An entry may come alone or listed, as a model, a dict or an OmegaConf node."""
    fields = HOPPER | {"env_kwargs": {"frame_skip": 3, "nested": [{"a": 1}]}}
    (config,) = parse_configs(wrap(fields))
    assert config == EnvConfig(**fields)
    assert type(config.env_kwargs["nested"]) is list


def test_shared_imports_precede_an_entrys_own(write: Write) -> None:
    """Every entry has them, and no module is listed twice."""
    document = {"imports": ["json", "os.path"], "envs": [HOPPER, CARTPOLE]}
    document["envs"][1] = CARTPOLE | {"imports": ["re", "json"]}
    first, second = load_config(write(document))
    assert first.imports == ("json", "os.path")
    assert second.imports == ("json", "os.path", "re")


EXPERIMENT = """
defaults: [_self_]
seed: 7
engine: {name: sync_rl, total_steps: "???"}
train: {lr: 3.0e-4, workers: 3}
log: {dir: "${no_such_resolver:now}"}
imports: [json]
env:
  - name: hopper
    backend: mujoco
    task: Hopper-v5
    num_workers: ${train.workers}
    num_cpus: 0
    imports: [re]
"""
"""The file of a complete experiment."""


def test_other_sections_of_a_file_are_ignored(write: Write) -> None:
    """Entries may refer to them, and overrides may change them."""
    path = write(EXPERIMENT)
    (config,) = load_config(path)
    assert (config.num_workers, config.num_cpus, config.imports) == (3, 0, ("json", "re"))
    assert load_config(path, ["train.workers=5"])[0].num_workers == 5
    with pytest.raises(ConfigError, match=r"trane\.workers=5"):
        load_config(path, ["trane.workers=5"])
    with pytest.raises(ConfigError, match="import: unknown field; did you mean 'imports'"):
        load_config(write(EXPERIMENT.replace("imports: [json]", "import: [json]")))


def test_a_node_of_a_document_has_its_imports(write: Write) -> None:
    """This holds for any way of taking entries out of an OmegaConf document."""
    config: Any = OmegaConf.load(write(EXPERIMENT))
    for part in (config, config.env, config.env[0], [config.env[0]]):
        (entry,) = parse_configs(part)
        assert (entry.num_workers, entry.imports) == (3, ("json", "re"))


def test_one_entry_needs_no_list(write: Write) -> None:
    """A section may be the entry itself; messages and overrides then have no position."""
    (config,) = load_config(write({"env": HOPPER}), ["env.num_workers=2"])
    assert config == EnvConfig(**HOPPER, num_workers=2)
    with pytest.raises(ConfigError, match=r"env \('hopper'\), num_worker: unknown field"):
        load_config(write({"env": HOPPER | {"num_worker": 2}}))


def test_interpolations_are_resolved(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    """OmegaConf's references may name other fields and environment variables."""
    monkeypatch.setenv("HOPPER_TASK", "Hopper-v5")
    entry = HOPPER | {"task": "${oc.env:HOPPER_TASK}", "num_workers": 4}
    other = CARTPOLE | {"num_workers": "${envs.0.num_workers}"}
    first, second = load_config(write({"envs": [entry, other]}))
    assert (first.task, second.num_workers) == ("Hopper-v5", 4)


def test_numbers_in_env_vars_become_text() -> None:
    """YAML reads a thread count as a number."""
    (config,) = parse_configs(HOPPER | {"env_vars": {"OMP_NUM_THREADS": 1, "SHARE": 0.5}})
    assert config.env_vars == {"OMP_NUM_THREADS": "1", "SHARE": "0.5"}


def test_an_interpreter_is_found_as_by_a_shell() -> None:
    """It may be a name on the PATH, a path, or begin with a home directory."""
    for interpreter in (sys.executable, Path(sys.executable).name):
        (config,) = parse_configs(HOPPER | {"interpreter": interpreter})
        assert config.interpreter == interpreter
    assert EnvConfig(**HOPPER, interpreter="~/bin/python").interpreter == str(
        Path.home() / "bin/python"
    )


def test_names_for_another_interpreter_are_not_checked() -> None:
    """Its imports and backends may differ from those of this one."""
    fields = HOPPER | {"interpreter": sys.executable, "imports": ["no_such_module"]}
    assert parse_configs(fields)[0].imports == ("no_such_module",)
    parse_configs(HOPPER | {"interpreter": sys.executable, "backend": "theirs"})
    check_installed(parse_configs(fields))


def test_an_imported_module_may_register_the_backend() -> None:
    """With imports, an unknown backend is left to the worker."""
    (config,) = parse_configs(HOPPER | {"backend": "brought", "imports": ["json"]})
    assert config.backend == "brought"


def test_checking_imports_runs_no_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A module, its package and a namespace package around it are found without being run."""
    package = tmp_path / "space" / "package"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError")
    (package / "module.py").write_text("raise RuntimeError")
    monkeypatch.syspath_prepend(tmp_path)
    parse_configs(HOPPER | {"imports": ["space", "space.package", "space.package.module"]})
    assert "no module 'space.package.other'" in problems_of(
        HOPPER | {"imports": ["space.package.other"]}
    )
    assert "no module 'space.package.module.deeper'" in problems_of(
        HOPPER | {"imports": ["space.package.module.deeper"]}
    )
    assert not [name for name in sys.modules if name.startswith("space")]


words = st.text(st.characters(categories=["L", "N", "P"], exclude_characters="?"), min_size=1)


@given(
    fields=st.fixed_dictionaries(
        {
            "name": words,
            "backend": st.sampled_from(["mujoco", "gymnasium"]),
            "task": words,
        },
        optional={
            "num_workers": st.integers(1, 10**6),
            "max_episode_steps": st.none() | st.integers(1, 10**9),
            "num_cpus": st.integers(0, 99) | st.floats(0, 99),
            "num_gpus": st.floats(0, 8),
            "envs_per_process": st.just("auto") | st.integers(1, 99),
            "step_timeout": st.none() | st.floats(1e-3, 1e9),
            "on_worker_death": st.sampled_from(["restart", "raise"]),
            "max_restarts": st.integers(0, 99),
            "env_vars": st.dictionaries(st.from_regex(r"\A[A-Z_]+\Z"), st.text("ab= ")),
            "env_kwargs": st.dictionaries(
                st.text("abc", min_size=1),
                st.recursive(
                    st.none() | st.booleans() | st.integers() | st.text("xyz 0:-#'"),
                    lambda inner: (
                        st.lists(inner, max_size=3)
                        | st.dictionaries(st.text("abc", min_size=1), inner, max_size=3)
                    ),
                    max_leaves=6,
                ),
                max_size=3,
            ),
        },
    )
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_an_entry_survives_yaml_and_pickle(fields: dict[str, Any], write: Write) -> None:
    """Reading back what was written gives the same entry."""
    config = EnvConfig(**fields)
    path = write(json.dumps({"envs": [fields]}, ensure_ascii=False))
    assert load_config(path) == parse_configs(fields) == [config]
    assert pickle.loads(pickle.dumps(config)) == config


# ---- overrides


def test_overrides_have_dotted_keys(write: Write) -> None:
    """Values are YAML, later ones win, and missing sections are created."""
    path = write({"envs": [HOPPER, CARTPOLE | {"env_kwargs": {"a": 1, "b": 2}}]})
    first, second = load_config(
        path,
        [
            "envs.0.num_workers=4",
            "envs.0.num_workers=8",
            "envs.0.env_kwargs.frame_skip=3",
            "envs.1.env_kwargs.b=[x, {y: 1}]",
            "envs.1.task=a=b",
            "imports=[json]",
        ],
    )
    assert (first.num_workers, first.env_kwargs, first.imports) == (8, {"frame_skip": 3}, ("json",))
    assert second.env_kwargs == {"a": 1, "b": ["x", {"y": 1}]}
    assert second.task == "a=b"


@pytest.mark.parametrize("in_file", ["env", "envs"])
@pytest.mark.parametrize("in_override", ["env", "envs"])
def test_overrides_may_use_env_or_envs(write: Write, in_file: str, in_override: str) -> None:
    """Both work, whichever of them the file uses."""
    path = write({in_file: [HOPPER]})
    assert load_config(path, [f"{in_override}.0.num_workers=8"])[0].num_workers == 8


@pytest.mark.parametrize(
    "override",
    [
        "envs.0.num_workers",
        "=8",
        "num_workers=8",
        "0.num_workers=8",
        "envs.1.num_workers=8",
        "envs.first.num_workers=8",
        "envs.0.env_kwargs=[1",
        "envs.0.task=${",
        "",
    ],
)
def test_an_override_that_fits_nothing_is_named(write: Write, override: str) -> None:
    """The message has the file and the override."""
    path = write({"envs": [HOPPER]})
    with pytest.raises(ConfigError) as caught:
        load_config(path, ["envs.0.num_workers=2", override])
    assert str(caught.value).startswith(f"{path}: ")
    assert override in str(caught.value)


def test_an_overridden_field_is_checked_like_any_other(write: Write) -> None:
    """It can't have a field or type that a file may not have."""
    with pytest.raises(ConfigError, match=r"envs\.0 \('hopper'\), num_worker: .*'num_workers'"):
        load_config(write({"envs": [HOPPER]}), ["envs.0.num_worker=8"])
    with pytest.raises(ConfigError, match=r"num_workers: should be a valid integer, got 'many'"):
        load_config(write({"envs": [HOPPER]}), ["envs.0.num_workers=many"])


# ---- refused configurations


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("num_worker", 3, "unknown field; did you mean 'num_workers'?"),
        ("zzz", 3, "unknown field; known: name, backend, task"),
        ("num_workers", "many", "should be a valid integer, got 'many'"),
        ("num_workers", "4", "should be a valid integer, got '4'"),
        ("num_workers", True, "should be a valid integer, got True"),
        ("num_workers", 0, "should be greater than or equal to 1, got 0"),
        ("num_workers", None, "should be a valid integer, got None"),
        ("max_episode_steps", 0, "should be greater than or equal to 1, got 0"),
        ("step_timeout", -1, "should be greater than 0, got -1"),
        ("start_timeout", math.nan, "should be greater than 0, got nan"),
        ("close_timeout", math.inf, "should be less than or equal to 86400, got inf"),
        (
            "placement",
            "inlin",
            "should be 'process', 'loop', 'inline' or 'ray', got 'inlin'",
        ),
        ("on_worker_death", "ignore", "should be 'restart' or 'raise', got 'ignore'"),
        ("envs_per_process", "many", "should be a valid integer or 'auto', got 'many'"),
        ("envs_per_process", 0, "should be greater than or equal to 1 or 'auto', got 0"),
        ("env_kwargs", [1], "should be a valid dictionary, got [1]"),
        ("imports", "json", "should be a list, got 'json'"),
        ("imports", ["json", 3], "should be a valid string, got 3"),
        ("imports", ["no_such_module"], "no module 'no_such_module' on this Python's path"),
        ("imports", ["not a name"], "no module 'not a name' on this Python's path"),
        ("imports", [""], "no module '' on this Python's path"),
        ("env_vars", {"A": True}, "should be a valid string, got True"),
        ("env_vars", {"A=B": "1"}, "'A=B' can't be set in an environment"),
        ("env_vars", {"": "1"}, "'' can't be set in an environment"),
        ("env_vars", {"A": "\0"}, "'A' can't be set in an environment"),
        ("interpreter", "/no/such/python", "'/no/such/python' doesn't exist"),
        ("interpreter", "no-such-python", "'no-such-python' doesn't exist"),
        ("interpreter", "/", "'/' is a directory; name the program in it"),
        ("interpreter", __file__, "is not executable"),
        ("backend", "mujco", "unknown backend 'mujco'; did you mean 'mujoco'? known: "),
        ("backend", "zzz", "unknown backend 'zzz'; known: "),
        ("task", "", "is required"),
        ("task", 5, "should be a name, a callable or a list of callables, got 5"),
    ],
)
def test_a_wrong_field_is_named_with_file_and_entry(
    write: Write, field: str, value: object, said: str
) -> None:
    """One problem is one line with file, entry (index and name), field and reason."""
    path = write({"envs": [CARTPOLE, HOPPER | {field: value}]})
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: envs.1 ('hopper'), {field}")
    assert said in message
    assert "\n" not in message
    assert caught.value.__cause__ is None


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        (
            {"name": "arm", "backend": "piper", "task": "can0", "num_envs": 4},
            "envs.0 ('arm'), num_envs: backend 'piper' makes single envs; use num_workers: 4",
        ),
        ([{"backend": "mujoco"}], "envs.0 ('mujoco'), task: is required"),
        ([{"num_workers": 2}], "envs.0, backend: is required"),
        (HOPPER | {"name": ""}, "envs.0, name: "),
        (
            [HOPPER, CARTPOLE, CARTPOLE | {"name": "hopper"}],
            "envs.2 ('hopper'), name: is also the name of envs.0",
        ),
        ("configs/hopper.yaml", "load_config reads files"),
        (CONFIGS / "hopper.yaml", "load_config reads files"),
    ],
    ids=str,
)
def test_what_is_missing_or_twice_is_named(entries: Any, said: str) -> None:
    """With what to do."""
    assert said in problems_of(entries)


VALUES: dict[str, Any] = {
    "num_workers": 2,
    "num_envs": 4,
    "placement": "inline",
    "envs_per_process": "auto",
    "step_timeout": 1.0,
    "reset_timeout": 1.0,
    "start_timeout": 120.0,
    "close_timeout": 2.0,
    "on_worker_death": "restart",
    "max_restarts": 0,
    "recycle": {"episodes": 9},
    "interpreter": sys.executable,
    "env_vars": {"A": "1"},
    "max_concurrency": 3,
    "ray_options": {"max_restarts": 0},
}
"""A value for each field that some place for envs refuses."""
INLINE = HOPPER | {"placement": "inline"}
SERVER = {"name": "robots", "backend": "env_server"}


@pytest.mark.parametrize(
    ("entry", "refuses"),
    [
        (INLINE, PLACEMENTS["inline"].refuses),
        (HOPPER | {"placement": "loop"}, PLACEMENTS["loop"].refuses),
        (SERVER, placement_of("env_server", "").refuses),
    ],
    ids=["inline", "loop", "env_server"],
)
def test_a_field_without_meaning_for_the_placement_is_refused(
    entry: dict[str, Any], refuses: Mapping[str, str]
) -> None:
    """Each is named once, with the reason; so is a default that asks for something."""
    for name, why in refuses.items():
        message = problems_of(entry | {name: VALUES[name]})
        place, _, text = message.partition(": ")[2].partition(": ")
        assert place == f"envs.0 ('{entry['name']}'), {name}"
        assert text.startswith("has no meaning with ")
        assert text.endswith(f": {why}")


def test_other_fields_are_accepted_for_the_placement() -> None:
    """So is a field that asks for nothing: no limit, no variables, one."""
    asks_nothing = {
        "step_timeout": None,
        "interpreter": None,
        "env_vars": {},
    }
    parse_configs(INLINE | asks_nothing | {"num_workers": 3, "num_gpus": 0.5})
    if BACKENDS["env_server"].is_installed():
        limits = {"step_timeout": 1.0, "reset_timeout": 1.0, "max_episode_steps": 9}
        parse_configs(SERVER | limits | {"num_workers": 1, "num_envs": 1})


def test_moving_an_entry_drops_fields_without_meaning() -> None:
    """All other fields are kept."""
    (config,) = parse_configs(HOPPER | {"step_timeout": 1.0, "num_workers": 3})
    assert moved(config, "inline") == parse_configs(INLINE | {"num_workers": 3})[0]
    parse_configs(moved(config, "inline"))
    assert moved(config, "process") == config


def test_one_message_lists_every_problem_of_a_file(write: Write) -> None:
    """So a user can fix all of them at once."""
    path = write(
        {
            "import": ["json"],
            "imports": ["no_such_module"],
            "envs": [
                HOPPER | {"num_worker": 1, "num_workers": "x", "num_envs": 2, "backend": "piper"},
                5,
                {"backend": "zzz", "interpreter": "/no/such/python"},
                HOPPER,
            ],
        }
    )
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    head, *lines = str(caught.value).split("\n")
    assert head == f"{path}: {len(lines)} problems"
    assert [line.split(": ")[0].strip() for line in lines] == [
        "import",
        "envs.0 ('hopper'), num_workers",
        "envs.0 ('hopper'), num_worker",
        "envs.0 ('hopper'), num_envs",
        "envs.1",
        "envs.2 ('zzz'), task",
        "envs.2 ('zzz'), interpreter",
        "envs.3 ('hopper'), name",
        "imports",
    ]


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ({"task": dict, "placement": "here"}, "placement: should be .* got 'here'"),
        ({"task": "os:getcwd", "num_workers": 0}, "num_workers: should be .* got 0"),
        ({"task": 3}, "task: should be a name, a callable .* got 3"),
        ({"task": [dict, dict], "num_workers": "two"}, "num_workers: should be .* got 'two'"),
    ],
    ids=str,
)
def test_an_entry_of_a_callable_has_no_message_about_its_backend(entry: Any, said: str) -> None:
    """The backend follows from the callable."""
    with pytest.raises(ConfigError, match=rf"configuration: envs\.0 \('e'\), {said}$"):
        parse_configs({"name": "e", **entry})


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("envs: [1\nb: 2", "line 2, column 2: not valid YAML"),
        ("envs: 1\nenvs: 2", "line 2, column 1: not valid YAML: found duplicate key envs"),
        ("envs: !!python/object:os.system x", "not valid YAML"),
        ("", "envs: no entries"),
        ("envs: []", "envs: no entries"),
        ("env: []", "env: no entries"),
        ("envs:", "envs: should be a list of entries, got None"),
        ("envs: {a: b}", "envs: should be a list of entries, got {'a': 'b'}"),
        ("7", "should hold envs: and a list of entries"),
        ("envs: ${no.such.key}", "envs: Interpolation key 'no.such.key' not found"),
        ("envs: [{name: '???'}]", "envs[0].name: Missing mandatory value"),
        ("env: []\nenvs: []", "env: means the same as envs"),
        ("imports: json\nenvs: []", "imports: should be a list of module names, got 'json'"),
        ("evns: []", "evns: unknown field; did you mean 'envs'?"),
    ],
)
def test_a_file_without_entries_is_refused_with_the_reason(
    write: Write, text: str, said: str
) -> None:
    """It may not parse, be empty, or hold something else."""
    path = write(text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert said in str(caught.value)


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    """It may be missing, a directory, or not text."""
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\xfa")
    for name in ("missing.yaml", "", "binary.yaml"):
        with pytest.raises(ConfigError) as caught:
            load_config(tmp_path / name)
        assert str(caught.value).startswith(f"{tmp_path / name}: ")


@pytest.mark.parametrize("cfgs", [None, 3, [], (), {}, [None], [[HOPPER]], object()])
def test_other_values_are_refused(cfgs: object) -> None:
    """Only entries are accepted."""
    assert problems_of(cfgs).startswith("environment configuration: ")


def test_env_config_lists_everything_that_is_wrong() -> None:
    """In the words of an entry that is a mapping, also for what is nested."""
    wrong: dict[str, Any] = {"name": "", "num_workers": "2", "placement": "moon"}
    with pytest.raises(ConfigError) as caught:
        EnvConfig(**{**wrong, "imports": ["math", 3], "nme": 1, "tsk": 2})
    said = str(caught.value)
    assert said.startswith("EnvConfig: 7 problems\n  name: String should have at least 1 character")
    for field in ("backend", "num_workers", "imports.1", "placement", "nme", "tsk"):
        assert f"\n  {field}: " in said
    assert "http" not in said


@given(text=st.text() | st.text("envs:[]{}-, \n\tab'\"&*!?|>%#0.$"))
@example(text="[" * 1000)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_any_text_gives_entries_or_a_config_error(text: str, write: Write) -> None:
    """No other exception is raised."""
    try:
        configs = load_config(write(text))
    except ConfigError:
        return
    assert configs


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["env", "envs", "imports", *EnvConfig.model_fields]) | st.integers(),
            inner,
            max_size=6,
        )
    ),
)


@given(cfgs=values)
@settings(deadline=None)
def test_any_value_gives_entries_or_a_config_error(cfgs: object) -> None:
    """No other exception is raised."""
    try:
        configs = parse_configs(cfgs)
    except ConfigError:
        return
    assert configs


# ---- simulators


@pytest.fixture
def absent(monkeypatch: pytest.MonkeyPatch) -> Backend:
    backend = Backend("absent", "nowhere:Env", "no_such_simulator", install="make absent")
    monkeypatch.setitem(BACKENDS, "absent", backend)
    return backend


def test_a_missing_simulator_is_named_with_its_install_command(absent: Backend) -> None:
    """The message names every entry that lacks one."""
    configs = parse_configs([HOPPER, CARTPOLE | {"backend": "absent"}])
    with pytest.raises(ConfigError) as caught:
        check_installed(configs)
    assert "envs.1 ('cartpole'), backend" in str(caught.value)
    assert "make absent" in str(caught.value)


# ---- configurations of the project


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_the_projects_configs_are_valid(path: Path) -> None:
    """Each file in configs/ is read; other interpreters need not exist."""
    document = yaml.safe_load(path.read_text())
    elsewhere = [k for k, entry in enumerate(document["envs"]) if "interpreter" in entry]
    assert load_config(path, [f"envs.{k}.interpreter={sys.executable}" for k in elsewhere])


def test_the_multi_task_example_is_two_tasks_of_one_action_shape() -> None:
    """One policy can act in both."""
    import gymnasium as gym

    configs = load_config(CONFIGS / "multi_task.yaml")
    envs = [gym.make(config.task, **config.env_kwargs) for config in configs]
    assert len({config.task for config in configs}) == 2
    assert len({env.action_space.shape for env in envs}) == 1
    for env in envs:
        env.close()


def test_importing_config_does_not_load_omegaconf() -> None:
    """Workers import it, too, and read no YAML."""
    code = "import rlightning_aio.config, sys; sys.exit('omegaconf' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def swing() -> Any:
    return gym.make("Pendulum-v1")


@pytest.mark.parametrize(
    ("given", "fields", "expected"),
    [
        ("CartPole-v1", {}, ("CartPole-v1", "gymnasium", 1)),
        ("CartPole-v1", {"num_workers": 8}, ("CartPole-v1", "gymnasium", 8)),
        (None, {"task": "Hopper-v5"}, ("Hopper-v5", "mujoco", 1)),
        ({"task": "Hopper-v5", "num_workers": 2}, {}, ("Hopper-v5", "mujoco", 2)),
        ("ALE/Pong-v5", {"backend": "ale", "name": "pong"}, ("pong", "ale", 1)),
        ("ALE/Pong-v5", {"backend": "ale"}, ("Pong-v5", "ale", 1)),
        ("http://127.0.0.1:8000", {"backend": "openenv"}, ("openenv", "openenv", 1)),
        (None, {"backend": "env_server"}, ("env_server", "env_server", 1)),
        ("test_config:swing", {}, ("swing", "callable", 1)),
        (swing, {"num_workers": 3}, ("swing", "callable", 3)),
        (partial(swing), {}, ("swing", "callable", 1)),
        ([swing] * 3, {}, ("swing", "callable", 3)),
        ([swing, gym.Env], {"step_timeout": 2.0}, ("env", "callable", 2)),
        (lambda: gym.make("Pendulum-v1"), {}, ("env", "callable", 1)),
    ],
)
def test_a_task_names_its_entry_and_its_backend(given: Any, fields: Any, expected: Any) -> None:
    """Whatever says what to build is enough, and fields are those of that entry."""
    (config,) = parse_configs(given, fields)
    assert (config.name, config.backend, config.num_workers) == expected
    for name, value in fields.items():
        assert getattr(config, name) == value


def test_names_callables_and_configs_may_be_listed() -> None:
    """Callables that follow one another make one entry."""
    found = parse_configs(["CartPole-v1", swing, gym.Env, {"task": "Hopper-v5"}])
    assert [config.name for config in found] == ["CartPole-v1", "env", "Hopper-v5"]
    assert [config.num_workers for config in found] == [1, 2, 1]


@pytest.mark.parametrize(
    ("given", "fields", "said"),
    [
        (HOPPER, {"num_workers": 2}, "num_workers: fields can be added to a task's name or to"),
        (["CartPole-v1"], {"step_timeout": 2}, "step_timeout: fields can be added"),
        ("CartPole-v1", {"task": "Hopper-v5"}, "task: is given twice"),
        ([swing] * 2, {"num_workers": 3}, "has 2 callables for num_workers: 3"),
        (None, {"num_worker": 3, "task": "Hopper-v5"}, "did you mean 'num_workers'"),
        (None, {}, "should be a list of entries, got None"),
    ],
)
def test_fields_that_belong_to_no_entry_are_refused(given: Any, fields: Any, said: str) -> None:
    """The message names the field."""
    with pytest.raises(ConfigError, match=said):
        parse_configs(given, fields)


@pytest.mark.parametrize(
    ("task", "backend"),
    [
        ("ale_py:ALE/Pong-v5", "gymnasium"),
        ("my_envs:Walk-v0", "gymnasium"),
        ("CartPole-v1", "gymnasium"),
        ("my_envs:make", "callable"),
        ("my.envs:Maker.make", "callable"),
    ],
)
def test_a_registered_name_with_its_module_is_no_callable(task: str, backend: str) -> None:
    """Versions and namespaces are in no name of Python."""
    assert EnvConfig(name="a", task=task).backend == backend


@pytest.mark.parametrize("task", ["CartPole-v1", "HalfCheetah-v5"])
def test_what_is_a_field_is_no_argument_of_the_env(task: str) -> None:
    """Gymnasium would say that it was given twice."""
    kwargs = {"max_episode_steps": 5, "num_envs": 5}
    said = "; ".join(f"{k}: is the field '{k}' of the entry; give it there" for k in kwargs)
    with pytest.raises(ConfigError, match=f"env_kwargs: {said}$"):
        build_env_group(EnvConfig(name="a", task=task, env_kwargs=kwargs))
