"""GPUs are assigned to workers before anything starts; these tests need no GPU."""

from __future__ import annotations

import os
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio import sync
from rlightning_aio._core.group.setup.devices import dealt_out, visible_devices
from rlightning_aio.config import EnvConfig
from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path


def worker(num_gpus: float, name: str = "e") -> EnvConfig:
    return EnvConfig(name=name, backend="mujoco", task="Ant-v5", num_gpus=num_gpus)


def shares(*wishes: float) -> list[str]:
    return [own.get("CUDA_VISIBLE_DEVICES", "") for own in dealt_out([worker(w) for w in wishes])]


@pytest.mark.parametrize(
    ("visible", "names"),
    [
        ("0,1", ["0", "1"]),
        ("3", ["3"]),
        ("", []),
        ("-1", []),
        ("1,-1,2", ["1"]),
        ("GPU-a", ["GPU-a"]),
    ],
)
def test_the_devices_of_the_trainer_are_assigned(
    monkeypatch: pytest.MonkeyPatch, visible: str, names: list[str]
) -> None:
    """The variable is read as CUDA reads it."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert visible_devices() == (names, f"CUDA_VISIBLE_DEVICES={visible}")


def test_without_the_variable_devices_are_counted(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """By the driver's program, if there are no device files."""
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr("rlightning_aio._core.group.setup.devices.Path", lambda _: tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert visible_devices()[0] == []
    program = tmp_path / "nvidia-smi"
    program.write_text(
        "#!/bin/sh\necho 'GPU 0: one (UUID: GPU-1)'\necho 'GPU 1: two (UUID: GPU-2)'\n"
    )
    program.chmod(0o755)
    assert visible_devices() == (["0", "1"], "nvidia-smi -L")
    (tmp_path / "nvidia0").touch()
    (tmp_path / "nvidiactl").touch()
    assert visible_devices() == (["0"], "/dev/nvidia*")


def test_each_worker_has_its_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole devices, or a part of one; MuJoCo renders on the first."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,5,6")
    assert shares(1, 0, 2) == ["4", "", "5,6"]
    assert shares(0.5, 0.5, 1, 0.3) == ["4", "4", "5", "6"]
    assert shares(1 / 3, 1 / 3, 1 / 3, 1) == ["4", "4", "4", "5"]
    assert dealt_out([worker(1)]) == [{"CUDA_VISIBLE_DEVICES": "4", "MUJOCO_EGL_DEVICE_ID": "4"}]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "GPU-a")
    assert dealt_out([worker(1)]) == [{"CUDA_VISIBLE_DEVICES": "GPU-a"}]


@given(st.lists(st.sampled_from([0, 0.25, 0.5, 1, 2]), max_size=8), st.integers(0, 5))
def test_no_device_is_assigned_twice(wishes: list[float], count: int) -> None:
    """Shares of one device add up to at most 1, or the config is refused."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CUDA_VISIBLE_DEVICES", ",".join(map(str, range(count))) or "-1")
        try:
            dealt = shares(*wishes)
        except ConfigError:
            return
        used = dict.fromkeys(map(str, range(count)), 0.0)
        for wish, names in zip(wishes, dealt, strict=True):
            for name in names.split(",") if names else ():
                used[name] += min(wish, 1)
        assert all(share <= 1 for share in used.values())
        assert [len(names.split(",")) if names else 0 for names in dealt] == [
            max(1, int(wish)) if wish else 0 for wish in wishes
        ]


def test_missing_devices_are_refused_before_anything_starts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The error has the number asked for and the number present."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")
    entry = {"name": "ant", "backend": "mujoco", "task": "Ant-v5", "num_workers": 4}
    with pytest.raises(
        ConfigError,
        match=r"entry 'ant', num_gpus: .* 4 workers of entry 'ant' with 1 each; visible here "
        r"\(CUDA_VISIBLE_DEVICES=0,1\): 2 \(0, 1\);",
    ):
        sync.build_env_group({**entry, "num_gpus": 1, "envs_per_process": 1})
    with pytest.raises(ConfigError, match=r"a whole number or less than 1, not 1\.5"):
        sync.build_env_group({**entry, "num_gpus": 1.5})


def test_this_process_needs_a_gpu_to_share(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = {"name": "ant", "backend": "mujoco", "task": "Ant-v5", "num_workers": 2}
    entry |= {"placement": "inline", "num_gpus": 1}
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    with pytest.raises(ConfigError, match=r"entry 'ant', num_gpus: .*visible here"):
        sync.build_env_group(entry)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    sync.build_env_group(entry).close()


def test_workers_find_their_share_in_their_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """So is the worker's index, if the entry asks for it."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,3")
    entry: dict[str, Any] = {
        "name": "e",
        "backend": "faulty",
        "task": "-",
        "imports": ["kit.faulty"],
        "num_workers": 4,
        "envs_per_process": 2,
        "num_gpus": 1,
        "env_vars": {"CACHE": "/tmp/cache-{process_index}", "BRACES": "{other}"},
    }
    names = ("CUDA_VISIBLE_DEVICES", "CACHE", "BRACES")
    with sync.build_env_group([entry, {**entry, "name": "f", "num_gpus": 0}]) as group:
        found = [
            [group[env_id].call("returns", partial(os.getenv, name)) for name in names]
            for env_id in ("e-0", "e-1", "e-2", "e-3", "f-3")
        ]
    assert found == [
        ["2", "/tmp/cache-0", "{other}"],
        ["2", "/tmp/cache-0", "{other}"],
        ["3", "/tmp/cache-1", "{other}"],
        ["3", "/tmp/cache-1", "{other}"],
        ["2,3", "/tmp/cache-1", "{other}"],
    ]
    assert "CACHE" not in os.environ
