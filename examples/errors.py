"""Wrong calls, and the errors that they raise: nothing is sent, so correct the call and go on.

python examples/errors.py
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio.collecting import Collector

if TYPE_CHECKING:
    from collections.abc import Callable


def raises(kind: type[BaseException], call: Callable[..., Any], *args: Any, **kwargs: Any) -> None:
    """Print the error that a call raises."""
    try:
        call(*args, **kwargs)
    except kind as error:
        print(f"{kind.__name__}: {error}")
    else:
        raise AssertionError(f"no {kind.__name__}")


def interrupted(batch: Any) -> Any:
    """Be a policy that is interrupted, as by Ctrl-C."""
    raise KeyboardInterrupt(f"while {len(batch)} envs wait")


def main() -> None:
    entry: dict[str, Any] = {"name": "pole", "task": "CartPole-v1", "num_workers": 2}
    raises(rl.ConfigError, sync.build_env_group, {**entry, "num_workrs": 8})  # No such field.
    raises(rl.StartFailed, sync.build_env_group({**entry, "task": "NoSuchTask-v1"}).init)

    with sync.build_env_group(entry) as group:
        raises(rl.NothingPending, group.collect_async)  # Nothing was asked, so nothing will come.
        raises(rl.UnknownEnv, group.reset, env_ids=["pole-9"])
        raises(rl.SnapshotError, group.snapshot)  # Of envs that were never reset.
        batch, _ = group.reset(seed=0)
        raises(rl.BadAction, group.step, batch.respond(action=[0.5, 1.5]))  # No whole numbers.
        group.step_async(batch.respond(action=[0, 1]))
        raises(rl.EnvBusy, group.step_async, batch.respond(action=[0, 1]))  # They owe results,
        group.collect_async(wait_all=True)  # which are still there.
        collector = Collector(group, interrupted, num_transitions=20)
        raises(KeyboardInterrupt, collector.collect)
        raises(rl.ResetNeeded, collector.collect)  # Until `collector.restart()` is called.
    raises(rl.GroupClosed, group.reset)  # An `RLightningError`, as all but Ctrl-C are.


if __name__ == "__main__":
    main()
