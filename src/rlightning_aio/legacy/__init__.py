"""The public path of a plug-in, `rlightning_aio.plugins.legacy`: runs programs for RLightning.

``python -m rlightning_aio.legacy script.py …`` runs a script; `install` does the same for a
program that calls it before it imports ``rlightning``.
"""

from __future__ import annotations

from rlightning_aio.plugins.legacy import install

__all__ = ["install"]
