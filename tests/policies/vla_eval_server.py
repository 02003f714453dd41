"""A model server of vla-eval: prints its port, then the size of each batch, until stdin ends.

Its argument is the options of `PredictModelServer` as JSON; ``broken`` makes each answer an error.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from typing import Any

import anyio
from policies.counting import chunk_of
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import serve_async


class Server(PredictModelServer):
    broken = False

    def predict_batch(self, obs_batch: Any, ctx_batch: Any) -> Any:
        if self.broken:
            raise KeyError("images")
        print(len(obs_batch), flush=True)  # noqa: T201
        return [{"actions": chunk_of(one["state"])} for one in obs_batch]


async def main() -> None:
    options = json.loads(sys.argv[1])
    broken = options.pop("broken", False)
    server = Server(**options)
    server.broken = broken
    async with anyio.create_task_group() as tasks:
        print(await tasks.start(serve_async, server, "127.0.0.1", 0), flush=True)  # noqa: T201
        threading.Thread(target=lambda: os._exit(len(sys.stdin.read()))).start()


anyio.run(main)
