"""`BatchedData`: many envs' results or responses, as ids and columns.

Rule: columns are what travels. An `EnvRet` or a `PolicyResponse` is made only when
somebody asks for it, and an info dict is decoded only when it is read. A batch owns its
arrays: nothing that happens later changes them (unless the group was built with
``zero_copy=True``). It can be pickled and deep-copied; the copy always owns its arrays, and
belongs to no group.
"""

from __future__ import annotations

from rlightning_aio.batch.data import BatchedData
from rlightning_aio.batch.joining import joined

__all__ = ["BatchedData", "joined"]
