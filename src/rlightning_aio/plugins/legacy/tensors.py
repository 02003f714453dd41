"""Moves arrays and tensors as RLightning does, with torch if it is installed."""

from __future__ import annotations

import contextlib
from functools import cache
from importlib import import_module
from typing import Any, cast

import numpy as np

from rlightning_aio.trees import as_numpy, converted, holds_tensor, is_tensor

__all__ = ["on_cpu", "resolve_object", "to_device", "to_numpy"]


@cache  # A search for a module that is missing takes as long as a step.
def _torch() -> Any:
    with contextlib.suppress(ImportError):
        return import_module("torch")
    return None


def to_device(data: Any, device: Any) -> Any:
    """Return `data` with its tensors and arrays as tensors on a torch device.

    Without torch, arrays stay arrays, and the device must be ``cpu``. An array of uint16 is taken
    for bfloat16, which NumPy lacks.
    """
    torch = _torch()
    if torch is None:
        if str(device) != "cpu":
            raise ImportError(f"device {device!r} needs torch, which is not installed")
        return data

    def moved(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            array = cast("np.ndarray[Any, Any]", value)
            if array.dtype.kind not in "biufc":
                return array
            # Torch takes no array that is read-only or has negative strides.
            writable = np.require(array, requirements=("C", "W")).reshape(array.shape)
            tensor = torch.from_numpy(writable)
            tensor = tensor.view(torch.bfloat16) if array.dtype == np.uint16 else tensor
            return tensor.to(device)
        is_movable = is_tensor(value) or type(value).__name__ == "TensorDict"
        return value.to(device) if is_movable else value

    return converted(moved, data)


def to_numpy(data: Any) -> Any:
    """Return `data` with its tensors as arrays; bfloat16 becomes uint16, bit for bit."""

    def moved(value: Any) -> Any:
        if is_tensor(value) and str(value.dtype) == "torch.bfloat16":
            return value.detach().cpu().view(_torch().uint16).numpy()
        return as_numpy(value)

    return converted(moved, data)


def on_cpu(data: Any) -> Any:
    """Return `data` with its tensors on the CPU, from where they can be pickled."""
    if not holds_tensor(data):
        return data
    return converted(lambda value: value.detach().cpu() if is_tensor(value) else value, data)


def resolve_object(obj: Any) -> Any:
    """Return `obj`: results are values here, never references of Ray."""
    return obj
