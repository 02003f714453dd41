"""Exporters of the numbers of a running group, which `EnvGroup.metrics` returns.

Prometheus and OpenTelemetry are optional: ``pip install rlightning_aio[metrics]``. Nothing happens
between two readings. Weights & Biases and TensorBoard take the numbers as they are.
Absent on purpose: servers, intervals and addresses, which both libraries have.
"""

from __future__ import annotations

import importlib
import weakref
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio._core.group.state.episode_counts import OUTCOMES

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rlightning_aio._core.group.api.facade import Facade

__all__ = ["PrometheusCollector", "opentelemetry_instruments"]


@dataclass(frozen=True)
class Figure:
    """What a number is to an exporter.

    Attributes:
        name: of an instrument of OpenTelemetry, which several numbers share that differ in their
            attributes.
        unit: of UCUM.
        text: about the instrument.
        attributes: of the number.
        only_grows: it is a counter, not a gauge.
    """

    name: str
    unit: str
    text: str
    attributes: Mapping[str, str] = field(default_factory=dict[str, str])
    only_grows: bool = False

    @property
    def name_in_prometheus(self) -> str:
        """Without dots, and with the unit at the end."""
        return self.name.replace(".", "_") + ("_seconds" if self.unit == "s" else "")


def _time(name: str, state: str) -> Figure:
    text = "Where the time has gone, by the state in which it passed."
    return Figure(name, "s", text, {"state": state}, only_grows=True)


def _envs(state: str) -> Figure:
    return Figure("rl.environment.count", "{environment}", "Envs by state.", {"state": state})


def _step(quantile: str) -> Figure:
    text = "Time in the env of the newest steps."
    return Figure("rl.environment.step.duration", "s", text, {"quantile": quantile})


def _lag(quantile: str) -> Figure:
    text = "How late the event loop returned calls that waited for results."
    return Figure("rl.environment.event_loop.lag", "s", text, {"quantile": quantile})


def _episodes(outcome: str) -> Figure:
    text = "Episodes that came to an end, by its kind."
    return Figure("rl.sample.episodes", "{episode}", text, {"outcome": outcome}, only_grows=True)


FIGURES: Final = {
    "steps": Figure("rl.environment.steps", "{step}", "Env steps.", only_grows=True),
    "steps_per_second": Figure("rl.environment.steps_per_second", "{step}/s", "Newest env steps."),
    "seconds_in_envs": _time("rl.environment.time", "in_env"),
    "seconds_queued": _time("rl.environment.time", "queued"),
    "seconds_waiting_to_be_collected": _time("rl.environment.time", "waiting_to_be_collected"),
    "seconds_waiting_for_actions": _time("rl.environment.time", "waiting_for_action"),
    "seconds_waiting_for_envs": _time("rl.loop.time", "waiting_for_envs"),
    "seconds_in_trainer": _time("rl.loop.time", "in_trainer"),
    "idle": _envs("idle"),
    "in_flight": _envs("in_flight"),
    "uncollected": _envs("uncollected"),
    "queued": Figure("rl.environment.queued", "{request}", "Requests that no env executes yet."),
    "oldest_request_seconds": Figure("rl.environment.request.age", "s", "Of the oldest request."),
    "batch_size": Figure("rl.sample.batch_size", "{result}", "Mean of the newest batches."),
    "step_seconds_p50": _step("0.5"),
    "step_seconds_p99": _step("0.99"),
    "slowest_env": Figure("rl.environment.slowest", "1", "Position of the slowest env."),
    "slowest_env_seconds": Figure("rl.environment.slowest.step.duration", "s", "Its mean step."),
    "restarts": Figure(
        "rl.environment.restarts", "{restart}", "Replacements of workers and envs.", only_grows=True
    ),
    **{f"outcomes_{kind}": _episodes(kind) for kind in OUTCOMES},
    "episode_return_mean": Figure("rl.environment.reward.mean", "1", "Mean return of episodes."),
    "episode_length_mean": Figure(
        "rl.environment.episode.length.mean", "{step}", "Mean length of episodes."
    ),
    "loop_lag_seconds_p99": _lag("0.99"),
    "loop_lag_seconds_max": _lag("1"),
}
"""The numbers of `EnvGroup.metrics`, without their prefix, and without `envs`, a sum of others."""


class _Reader:
    """Reads a group, which it doesn't keep alive: each number of each entry, where it has them.

    The group may be at work in another thread, so a time may be read some milliseconds late, and
    then be smaller. A counter must not: that would say that it was set to zero.
    """

    def __init__(self, group: Facade) -> None:
        self._group = weakref.ref(group)
        self._counted: dict[tuple[str, str], float] = {}

    def read(self) -> Iterator[tuple[str, dict[str, str], float]]:
        """Return name, attributes and value of each number."""
        group = self._group()
        numbers = {} if group is None else group.metrics(by_entry=True)
        by_entry = [key.removeprefix("envs/").rpartition("/") for key in numbers]
        of_entries = {name for entry, _, name in by_entry if entry}
        for (entry, _, name), value in zip(by_entry, numbers.values(), strict=True):
            if name not in FIGURES or (not entry and name in of_entries):
                continue
            attributes = dict(FIGURES[name].attributes)
            if entry:
                attributes["rl.environment.name"] = entry
            if FIGURES[name].only_grows:
                value = max(value, self._counted.get((entry, name), 0))  # noqa: PLW2901
                self._counted[entry, name] = value
            yield name, attributes, value


class PrometheusCollector:
    """A collector for a registry of ``prometheus_client``::

        from prometheus_client import REGISTRY, start_http_server

        REGISTRY.register(PrometheusCollector(group))
        start_http_server(9100)

    Each scrape reads the group once. A second group needs a registry of its own.

    Args:
        group: of either kind.
    """

    def __init__(self, group: Facade) -> None:
        self._reader = _Reader(group)

    def collect(self) -> Iterator[Any]:
        """Yield the metric families, as a registry asks for them."""
        core = importlib.import_module("prometheus_client.core")
        families: dict[str, Any] = {}
        for name, attributes, value in self._reader.read():
            figure = FIGURES[name]
            labels = {key.replace(".", "_"): text for key, text in attributes.items()}
            key = figure.name_in_prometheus
            if key not in families:
                kind = core.CounterMetricFamily if figure.only_grows else core.GaugeMetricFamily
                families[key] = kind(key, figure.text, labels=list(labels))
            families[key].add_metric(list(labels.values()), value)
        yield from families.values()


def opentelemetry_instruments(group: Facade, meter: Any) -> list[Any]:
    """Make observable instruments of a meter of OpenTelemetry, which its reader reads::

        opentelemetry_instruments(group, opentelemetry.metrics.get_meter("training"))

    Args:
        group: of either kind.
        meter: makes counters and gauges.

    Returns the instruments, which nobody needs to keep.
    """
    observation: Any = importlib.import_module("opentelemetry.metrics").Observation
    reader = _Reader(group)

    def observe(instrument: str, options: object) -> list[Any]:
        del options
        return [
            observation(value, attributes)
            for name, attributes, value in reader.read()
            if FIGURES[name].name == instrument
        ]

    instruments: dict[str, Any] = {}
    for figure in FIGURES.values():
        if figure.name not in instruments:
            make = (
                meter.create_observable_counter
                if figure.only_grows
                else meter.create_observable_gauge
            )
            instruments[figure.name] = make(
                figure.name,
                callbacks=[partial(observe, figure.name)],
                unit=figure.unit,
                description=figure.text,
            )
    return list(instruments.values())
