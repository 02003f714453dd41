"""How long tests wait for an event that must come."""

from __future__ import annotations

HANG = 200.0
"""Seconds after which a test counts as hung; no measure of speed.

On a busy machine, anything may take long.
"""
