"""RLightning's timers for the methods of envs."""

from __future__ import annotations

import contextlib
import functools
import logging
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

__all__ = ["get_logger", "log_metric", "record_timing", "timer", "timer_wrap"]


def get_logger(name: str) -> logging.Logger:
    """Return Python's own logger with this name."""
    return logging.getLogger(name)


def log_metric(
    payload: dict[str, Any],
    level: int = logging.INFO,
    step: int | None = None,
    prefix: str | None = None,
) -> None:
    """Log a line for each metric of `payload`."""
    for name, value in payload.items():
        label = f"{prefix}/{name}" if prefix else name
        logging.getLogger("rlightning").log(level, "%s: %s (step %s)", label, value, step)


def record_timing(
    name: str, duration_s: float, timing_raw: dict[str, dict[str, Any]], level: str = "info"
) -> None:
    """Add one duration, in seconds, to the sums of `timing_raw`: count, total and avg."""
    entry = timing_raw.setdefault(name, {"count": 0, "total": 0.0, "avg": 0.0})
    entry["count"] += 1
    entry["total"] += float(duration_s)
    entry["avg"] = entry["total"] / entry["count"]
    logger = logging.getLogger("rlightning.profiler")
    logger.log(logging.INFO if level == "info" else logging.DEBUG, "%s: %.4f s", name, duration_s)


@contextlib.contextmanager
def timer(
    name: str, timing_raw: dict[str, dict[str, Any]], level: str = "info", enable: bool = True
) -> Generator[None]:
    """Record the duration of the block."""
    began = time.perf_counter()
    yield
    if enable:
        record_timing(name, time.perf_counter() - began, timing_raw, level)


def timer_wrap(
    name: str | None = None, level: str = "info", log_to_metric: bool = False, enable: bool = True
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorate a method to record each call's duration in the object's ``timing_raw``."""

    def decorate(method: Callable[..., Any]) -> Callable[..., Any]:
        label = name or method.__name__

        @functools.wraps(method)
        def timed(self: Any, *args: Any, **kwargs: Any) -> Any:
            timing_raw: dict[str, dict[str, Any]] = self.__dict__.setdefault("timing_raw", {})
            with timer(label, timing_raw, level, enable):
                value = method(self, *args, **kwargs)
            if log_to_metric and enable:
                log_metric({label: timing_raw[label]["avg"]}, prefix="Performance")
            return value

        return timed

    return decorate
