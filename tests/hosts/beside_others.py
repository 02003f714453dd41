"""What tests of hosts need that share a group with others; callers choose the hosts."""

from __future__ import annotations

from typing import Any

from rlightning_aio import BatchedData, PolicyResponse


def entry(name: str, backend: str, placement: str, **fields: Any) -> Any:
    fields = {"task": "-", "imports": ["group.sample_envs"], **fields}
    return {"name": name, "backend": backend, "placement": placement, **fields}


def steps(**actions: Any) -> BatchedData:
    ids = [name.replace("_", "-") for name in actions]
    responses = [PolicyResponse(i, a) for i, a in zip(ids, actions.values(), strict=True)]
    return BatchedData(ids, responses)
