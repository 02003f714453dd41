"""Draw the README's picture from kept results: `docs/pictures/speed.svg`.

    python benchmarks/picture.py

`run_all.py` does it after each run, so the picture shows what the tables say.
"""

from __future__ import annotations

import json
from pathlib import Path
from xml.sax.saxutils import escape

RESULTS = Path(__file__).resolve().parent / "results"
PICTURE = RESULTS.parent.parent / "docs" / "pictures" / "speed.svg"
THEIRS = "Gymnasium AsyncVectorEnv"
# Title, results, and our contender, which is compared with Gymnasium's.
PANELS = (
    ("32 x HalfCheetah-v5, make_vec", "headline", "rlightning_aio make_vec"),
    ("64 x CartPole-v1, step", "cartpole", "rlightning_aio sync"),
    ("64 envs of uneven speed, first ready", "stragglers", "rlightning_aio async, first ready"),
)
WIDTH, PANEL, TOP, LEFT, LONGEST = 720, 92, 44, 190, 400
BAR, GAP = 22, 6
OURS_COLOUR, THEIRS_COLOUR = "#3f51b5", "#b0b4c3"


def drawn(results: Path) -> str:
    """Return the picture as SVG: a pair of bars for each of `PANELS`, env steps per second."""
    height = TOP + PANEL * len(PANELS)
    size = f'viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="14">',
        "<title>Env steps per second beside Gymnasium</title>",
        f'<rect width="{WIDTH}" height="{height}" rx="8" fill="#ffffff"/>',
        _text(16, 26, "Env steps per second on two cores", weight="bold"),
    ]
    for number, (title, name, ours) in enumerate(PANELS):
        medians = json.loads((results / f"{name}.json").read_text())["results"]
        rates = medians[ours]["median"], medians[THEIRS]["median"]
        top = TOP + number * PANEL
        parts.append(_text(16, top + 16, f"{title}: {rates[0] / rates[1]:.1f} times as fast"))
        names = ("rlightning_aio", "AsyncVectorEnv")
        for row, (label, rate) in enumerate(zip(names, rates, strict=True)):
            y = top + 26 + row * (BAR + GAP)
            length = LONGEST * rate / max(rates)
            parts += [
                _text(LEFT - 10, y + 16, label, anchor="end"),
                _bar(y, length, OURS_COLOUR if row == 0 else THEIRS_COLOUR),
                _text(LEFT + length + 8, y + 16, _rounded(rate)),
            ]
    return "\n".join([*parts, "</svg>", ""])


def _bar(y: int, length: float, colour: str) -> str:
    shape = f'x="{LEFT}" y="{y}" width="{length:.0f}" height="{BAR}" rx="3"'
    return f'<rect {shape} fill="{colour}"/>'


def _text(x: float, y: int, text: str, *, anchor: str = "start", weight: str = "normal") -> str:
    return (
        f'<text x="{x:.0f}" y="{y}" text-anchor="{anchor}" font-weight="{weight}" '
        f'fill="#22252d">{escape(text)}</text>'
    )


def _rounded(rate: float) -> str:
    """Round to three digits, as in the tables."""
    return f"{float(f'{rate:.3g}'):,.0f}"


if __name__ == "__main__":
    PICTURE.write_text(drawn(RESULTS))
