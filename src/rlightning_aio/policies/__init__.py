"""Policies, and what they may return; action chunks, and models of Stable-Baselines3 and LeRobot.

Rule: a policy is called with a batch of results and returns one action for each, and whatever it
keeps between calls belongs to one env's episode and ends with it.
"""

from __future__ import annotations

from rlightning_aio.policies.chunks import ActionChunks
from rlightning_aio.policies.lerobot import LeRobotPolicy

__all__ = ["ActionChunks", "LeRobotPolicy"]
