"""`LogSettings`: how the trainer's program logs, so that its workers log alike.

A worker has Python's own settings, which drop all below WARNING. It writes records as the first
handler of the program does that is one of the module `logging`, but to its stderr, which the
trainer shows. Left out: filters, and handlers and formatters of other classes.
"""

from __future__ import annotations

import copy
import logging
import sys
from dataclasses import dataclass
from typing import Final, TextIO

_PLAIN: Final = logging.Formatter(logging.BASIC_FORMAT)


@dataclass(frozen=True, slots=True)
class LogSettings:
    """The settings.

    Attributes:
        formatter: of the handler; level: its level.
        levels: of loggers that have one; the root's name is empty.
        disabled: the level up to which all logging is switched off.
    """

    formatter: logging.Formatter
    level: int
    levels: dict[str, int]
    disabled: int


def log_settings() -> LogSettings | None:
    """Return the settings of this process; None if its program has set up nothing."""
    root = logging.getLogger()
    known = (one for one in root.handlers if type(one).__module__.partition(".")[0] == "logging")
    if (handler := next(known, None)) is None:
        return None
    given = handler.formatter
    loggers = {"": root, **root.manager.loggerDict}
    levels = {
        name: one.level
        for name, one in loggers.items()
        if isinstance(one, logging.Logger) and one.level
    }
    formatter = given if type(given) is logging.Formatter else _PLAIN
    return LogSettings(formatter, handler.level, levels, root.manager.disable)


def log_like(settings: LogSettings, name: str) -> None:
    """Log so in this process, and show its `name` in each record.

    That is the ``processName`` of the format, or stands before the message.
    """
    logging.getLogger().addHandler(_Naming(settings, name))
    logging.disable(settings.disabled)
    for logger, level in settings.levels.items():
        logging.getLogger(logger).setLevel(level)


class _Naming(logging.StreamHandler[TextIO]):
    def __init__(self, settings: LogSettings, name: str) -> None:
        super().__init__(sys.stderr)
        self.setLevel(settings.level)
        self.setFormatter(settings.formatter)
        self._worker = name
        self._is_shown = "processName" in str(vars(settings.formatter)["_fmt"])

    def format(self, record: logging.LogRecord) -> str:
        own = copy.copy(record)  # Other handlers may have it.
        own.processName = self._worker
        if not self._is_shown:
            own.msg, own.args = f"[{self._worker}] {record.getMessage()}", ()
        return super().format(own)
