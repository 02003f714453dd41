"""Exporters of a group's numbers with the real libraries, and the page about these numbers."""

from __future__ import annotations

import gc
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from test_docs import blocks, run_programs

from rlightning_aio import sync
from rlightning_aio.metrics import FIGURES, PrometheusCollector, opentelemetry_instruments

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

ENTRY = {"backend": "gymnasium", "task": "CartPole-v1", "placement": "inline"}


@pytest.fixture
def group() -> Iterator[sync.EnvGroup]:
    entries = [{**ENTRY, "name": "a", "num_workers": 2}, {**ENTRY, "name": "b", "num_workers": 1}]
    with sync.build_env_group(entries) as group, group.auto_reset():
        batch, _ = group.reset(seed=0)
        for _ in range(40):
            batch, _ = group.step(batch.respond(action=np.zeros(3, int)))
        yield group


def test_prometheus_gets_every_number(group: sync.EnvGroup) -> None:
    """By entry where it has one; counters with their suffix; as its own parser reads them."""
    client = pytest.importorskip("prometheus_client")
    parser: Any = pytest.importorskip("prometheus_client.parser")
    registry = client.CollectorRegistry()
    registry.register(PrometheusCollector(group))
    text = client.generate_latest(registry).decode()
    found: dict[str, dict[tuple[str, ...], float]] = {}
    for family in parser.text_string_to_metric_families(text):
        for one in family.samples:
            key = tuple(value for _, value in sorted(one.labels.items()))
            found.setdefault(one.name, {})[key] = one.value
    numbers = group.metrics(by_entry=True)
    assert found["rl_environment_steps_total"] == {
        ("a",): numbers["envs/a/steps"],
        ("b",): numbers["envs/b/steps"],
    }
    episodes = found["rl_sample_episodes_total"]
    assert episodes["terminated", "a"] == numbers["envs/a/outcomes_terminated"] > 0
    assert found["rl_environment_reward_mean"]["b",] == numbers["envs/b/episode_return_mean"]
    assert set(found["rl_loop_time_seconds_total"]) == {("waiting_for_envs",), ("in_trainer",)}
    in_envs = found["rl_environment_time_seconds_total"]
    assert in_envs["a", "in_env"] == pytest.approx(numbers["envs/a/seconds_in_envs"])
    suffix = {name: "_total" if figure.only_grows else "" for name, figure in FIGURES.items()}
    names = {
        figure.name_in_prometheus + suffix[name]
        for name, figure in FIGURES.items()
        if f"envs/{name}" in numbers
    }
    assert set(found) == names


def test_opentelemetry_gets_every_number(group: sync.EnvGroup) -> None:
    """The same, by its own reader; a group that is gone has none."""
    pytest.importorskip("opentelemetry.sdk.metrics")
    from opentelemetry.sdk.metrics import MeterProvider
    from opentelemetry.sdk.metrics.export import InMemoryMetricReader

    reader = InMemoryMetricReader()
    provider = MeterProvider([reader])
    opentelemetry_instruments(group, provider.get_meter("test"))
    numbers = group.metrics(by_entry=True)
    found = _points(reader)
    assert found["rl.environment.steps"]["a",] == numbers["envs/a/steps"]
    assert found["rl.sample.episodes"]["terminated", "b"] == numbers["envs/b/outcomes_terminated"]
    assert set(found) == {f.name for n, f in FIGURES.items() if f"envs/{n}" in numbers}
    gone = sync.build_env_group({**ENTRY, "name": "c", "num_workers": 1})
    reader_of_gone = InMemoryMetricReader()
    opentelemetry_instruments(gone, MeterProvider([reader_of_gone]).get_meter("test"))
    del gone
    gc.collect()
    assert _points(reader_of_gone) == {}
    provider.shutdown()


def _points(reader: Any) -> dict[str, dict[tuple[str, ...], float]]:
    data = reader.get_metrics_data()
    found: dict[str, dict[tuple[str, ...], float]] = {}
    for resource in [] if data is None else data.resource_metrics:
        for scope in resource.scope_metrics:
            for metric in scope.metrics:
                for point in metric.data.data_points:
                    key = tuple(text for _, text in sorted(point.attributes.items()))
                    found.setdefault(metric.name, {})[key] = point.value
    return found


def test_tensorboard_takes_the_numbers_as_they_are(group: sync.EnvGroup, tmp_path: Path) -> None:
    """Each becomes a curve of its name."""
    board = pytest.importorskip("tensorboardX")
    with board.SummaryWriter(str(tmp_path)) as writer:
        for name, number in group.metrics().items():
            writer.add_scalar(name, number, 1)
    (file,) = tmp_path.iterdir()
    assert all(name.encode() in file.read_bytes() for name in group.metrics())


def test_the_page_tells_who_starves(tmp_path: Path) -> None:
    """In each of its three runs, the shares that it names are the ones that are large."""
    named = (
        {"waiting_for_envs", "in_envs"},
        {"waiting_to_be_collected"},
        {"in_trainer", "waiting_for_actions"},
    )
    least, printed = 0, ""
    for _ in range(20):
        printed = run_programs(blocks("python", "metrics.md")[1:2], tmp_path)
        runs = printed.split("slowest: ")[:3]
        shares = [re.findall(r"^(\d+)% of .*: (\w+)$", run, re.MULTILINE) for run in runs]
        assert [named[k] - {name for _, name in shares[k]} for k in range(3)] == [set()] * 3
        least = min(int(share) for k in range(3) for share, name in shares[k] if name in named[k])
        if least > 50:
            break  # On a busy machine, all may wait for a core instead.
    assert least > 50
    second = re.match(r"Slow-2, (\S+) s", printed.split("slowest: ")[2])
    assert second is not None
    assert float(second[1]) >= 0.1


def test_the_programs_of_the_page_run(tmp_path: Path) -> None:
    """Deaths are counted by entry, and the exporters give the page's names."""
    pytest.importorskip("prometheus_client")
    pytest.importorskip("opentelemetry.sdk.metrics")
    pytest.importorskip("tensorboardX")
    first, _, fails, board, prometheus, telemetry = blocks("python", "metrics.md")
    printed = run_programs([first, fails, board, prometheus, telemetry], tmp_path)
    assert "sound: 0 restarts, 0 episodes lost" in printed
    assert re.search(r"fragile: [4-9] restarts, [4-9] episodes lost", printed)
    for name in ("rl_sample_episodes_total", '"rl.environment.time"', "envs/steps_per_second"):
        assert name in printed
