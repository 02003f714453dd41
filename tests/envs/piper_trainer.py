"""A trainer that is killed while its arm moves: ``python piper_trainer.py CHANNEL PLACEMENT``."""

from __future__ import annotations

import os
import sys

from rlightning_aio import BatchedData, PolicyResponse, sync

FAR = [1.5, 2.0, -2.0, 1.0, 1.0, 1.0, 0.0]


def main(channel: str, placement: str) -> None:
    os.environ["CAN_CONFIG"] = '{"sleep_after_open": 0.0}'
    entry = {
        "name": "arm",
        "backend": "piper",
        "task": "test",
        "placement": placement,
        "env_kwargs": {
            "can_interface": "slcan",
            "channel": channel,
            "speed": 5,
            "safe_stop": "emergency_stop",
            "feedback_timeout": 5.0,
            # A busy machine lets no thread run in time.
            "watchdog_timeout": 5.0,
        },
    }
    with sync.build_env_group(entry) as group:
        group.reset()
        while True:
            group.step(BatchedData(["arm-0"], [PolicyResponse("arm-0", FAR)]))
            sys.stdout.write("moving\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
