"""`BatchedData`: results of envs, or responses to them, as ids and columns.

Rule: columns are passed on unchanged; an `EnvRet` or a `PolicyResponse` is made only on request,
and an info dict is decoded only when it is read. A batch owns its arrays, which never change
later (unless the group was built with ``zero_copy=True``). It can be pickled and deep-copied; the
copy always owns its arrays, and belongs to no group.
"""

from __future__ import annotations

from rlightning_aio.batch.data import BatchedData
from rlightning_aio.batch.joining import joined

__all__ = ["BatchedData", "joined"]
