"""A headless Chromium that tests drive over its DevTools protocol, without further packages."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Self

from patience import HANG
from websockets.sync.client import connect

if TYPE_CHECKING:
    from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--hide-scrollbars", "--remote-debugging-port=0",
)  # fmt: skip


def found_browser() -> str | None:
    """The path of the first browser that is installed."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One page of a browser.

    Args:
        path: of its program.
        profile: an empty folder.
    """

    def __init__(self, path: str, profile: Path) -> None:
        self._command = [path, *FLAGS, f"--user-data-dir={profile}", "about:blank"]
        self._number, self._session = 0, {}

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            process = stack.enter_context(
                subprocess.Popen(
                    self._command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
                )
            )
            stack.callback(process.kill)
            assert process.stderr is not None
            address = next(
                found[0] for line in process.stderr if (found := re.search(r"ws://(\S+)", line))
            )
            self._socket = stack.enter_context(connect(address, max_size=None, open_timeout=HANG))
            self._attach()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def _attach(self) -> None:
        (page,) = [t for t in self.call("Target.getTargets")["targetInfos"] if t["type"] == "page"]
        attached = self.call("Target.attachToTarget", targetId=page["targetId"], flatten=True)
        self._session = {"sessionId": attached["sessionId"]}
        self.call("Page.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol; other messages are dropped meanwhile."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params, **self._session}
        self._socket.send(json.dumps(message))
        return self._received(lambda reply: reply.get("id") == self._number)["result"]

    def _received(self, wanted: Any) -> dict[str, Any]:
        while True:
            message = json.loads(self._socket.recv(timeout=HANG))
            if wanted(message):
                return message

    def open(self, url: str, width: int, height: int = 900) -> None:
        """Show a page in a window of that size, and wait until it is loaded."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=width < 600,
        )  # fmt: skip
        self.call("Page.navigate", url=url)
        self.evaluate(
            "new Promise(done => document.readyState === 'complete' ? done()"
            " : addEventListener('load', done))"
        )

    def evaluate(self, expression: str) -> Any:
        """The value of an expression of JavaScript, or of its promise, in the page."""
        reply = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in reply, reply
        return reply["result"].get("value")

    def screenshot(self, file: Path) -> None:
        """Write what the window shows as a PNG."""
        file.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))
