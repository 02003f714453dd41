"""How long tests wait for what must come."""

from __future__ import annotations

HANG = 200.0
"""Seconds past which something will never come; no measure of speed.

A machine that is busy with other things may take its time for whatever a test does.
"""
