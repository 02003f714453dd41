"""Plots of measurements; only they need matplotlib."""

from __future__ import annotations

import importlib
import importlib.util
import io
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.cli.terminal import counted
from rlightning_aio.errors import ConfigError
from rlightning_aio.files import check_writable, write_file
from rlightning_aio.sharing import num_cores

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rlightning_aio.cli.measuring import Contender
    from rlightning_aio.evaluation import Estimate, Evaluation

_KINDS: Final = (".png", ".svg", ".pdf")


def check_plot(path: Path | None) -> None:
    """Check before the measurement that a plot can be drawn, if there is to be one.

    Raises:
        ConfigError, OSError: it can't, with the reason.
    """
    if path is None:
        return
    if path.suffix.lower() not in _KINDS:
        raise ConfigError(f"--plot {path}: should end in {', '.join(_KINDS[:-1])} or {_KINDS[-1]}")
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigError("--plot needs matplotlib: pip install matplotlib")
    check_writable(path)


def _pyplot() -> Any:
    importlib.import_module("matplotlib").use("Agg")
    return importlib.import_module("matplotlib.pyplot")


def _save(plt: Any, figure: Any, path: Path) -> None:
    picture = io.BytesIO()
    try:
        figure.savefig(picture, dpi=150, format=path.suffix[1:].lower())
    finally:
        plt.close(figure)
    write_file(path, picture.getvalue())


def draw_contenders(config: str, contenders: Sequence[Contender], path: Path) -> None:
    """Draw bars of steps per second with the rounds' spread, grouped by place.

    Raises:
        OSError: the plot can't be written.
    """
    plt = _pyplot()
    measured = [contender for contender in contenders if contender.rounds]
    rules = list(dict.fromkeys(contender.rule.words for contender in measured))
    places = list(dict.fromkeys(contender.place.words for contender in measured))
    figure, axes = plt.subplots(figsize=(8, 1.4 + 0.22 * len(measured)), layout="constrained")
    height = 0.8 / len(rules)
    for index, rule in enumerate(rules):
        own = [contender for contender in measured if contender.rule.words == rule]
        axes.barh(
            [places.index(c.place.words) + index * height for c in own],
            [c.rates.median for c in own],
            height,
            xerr=[c.rates.spread * c.rates.median for c in own],
            ecolor="gray",
            label=rule,
        )
    axes.set_yticks([k + 0.4 - height / 2 for k in range(len(places))], places)
    axes.invert_yaxis()
    axes.set(xlabel="env steps per second", title=f"{config}, {counted(num_cores(), 'core')}")
    figure.legend(loc="outside lower center", ncols=len(rules))
    _save(plt, figure, path)


def draw_evaluation(
    config: str, groups: Sequence[tuple[str, Evaluation, Sequence[float]]], path: Path
) -> None:
    """Draw each episode's return and the means, and success rates where there are any, with their
    95 % intervals.

    Args:
        config: title of the plot.
        groups: name, figures and returns of each entry or task.
        path: the file.

    Raises:
        OSError: the plot can't be written.
    """
    plt = _pyplot()
    judged = any(found.success is not None for _, found, _ in groups)
    figure, axes = plt.subplots(
        1, 1 + judged, squeeze=False, figsize=(9, 1.8 + 0.35 * len(groups)), layout="constrained"
    )
    returns, *rates = axes[0]
    for place, (_, found, values) in enumerate(groups):
        returns.plot(values, [place] * len(values), "|", alpha=0.4, ms=12)
        _draw_estimate(returns, found.total_reward, place)
        for axis in rates:
            _draw_estimate(axis, found.success, place)
    returns.set(xlabel="return of an episode; mean, 95 %", title=config)
    for axis in rates:
        axis.set(xlabel="success rate, 95 %", xlim=(-0.02, 1.02))
    for axis in axes[0]:
        axis.set_yticks(range(len(groups)), [name for name, _, _ in groups])
        axis.set_ylim(len(groups) - 0.5, -0.5)
    _save(plt, figure, path)


def _draw_estimate(axes: Any, one: Estimate | None, place: int) -> None:
    if one is not None:
        low, high = (one.mean if end is None else end for end in (one.low, one.high))
        ends = [[one.mean - low], [high - one.mean]]
        axes.errorbar(one.mean, place, xerr=ends, fmt="o", capsize=4, color="black")
