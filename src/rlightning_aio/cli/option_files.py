"""Files that options name: what is wrong with one is said with the option, in one line."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from rlightning_aio.errors import ConfigError, RLightningError
from rlightning_aio.files import check_writable

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path

__all__ = ["check_option_file", "naming_option"]


@contextlib.contextmanager
def naming_option(option: str, path: Path) -> Generator[None]:
    """Turn an `OSError` of writing `path` into a `ConfigError` that names `option`."""
    try:
        yield
    except RLightningError:
        raise  # Some are an `OSError`, too.
    except OSError as error:
        raise ConfigError(f"{option} {path}: can't be written: {error.strerror}") from error


def check_option_file(option: str, path: Path | None) -> None:
    """Find out, before anything is started, whether the file of an option can be written.

    Raises:
        ConfigError: it can't; the message says why.
    """
    if path is not None:
        with naming_option(option, path):
            check_writable(path)
