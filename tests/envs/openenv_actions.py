"""Seeds and actions of the episodes that are played over the wire and directly."""

from __future__ import annotations

from typing import Any

STEPS = 6
"""An episode is cut after so many, if its env goes on."""


def seed_of(session: int, episode: int) -> int:
    return 1000 * episode + session


def action_of(kind: str, session: int, episode: int, step: int) -> dict[str, Any]:
    if kind == "dice":
        return {"move": (session + episode) % 4}
    return {"message": f"{session} {episode} {step}: é" * (step % 3)}
