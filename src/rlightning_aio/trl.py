"""TRL's `environment_factory`, over a group of envs with time limits and replacements.

Rule: a rollout that fails has no reward. TRL takes None for that: such a rollout counts neither for
the loss nor for the mean of its group.
"""

from __future__ import annotations

import functools
import inspect
from typing import TYPE_CHECKING, Any, Self

from rlightning_aio.attempts.episode import AttemptInPlay
from rlightning_aio.attempts.lending import LendingThread
from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.called import called_env
from rlightning_aio.errors import EnvError, EnvFault, RLightningError

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio.outcomes import Outcome

__all__ = ["Environments"]


class Environments:
    """Pass it to TRL's `GRPOTrainer` as its `environment_factory`::

        with Environments(Shop, num_envs=32, reset_timeout=60, step_timeout=60) as environments:
            trainer = GRPOTrainer(..., environment_factory=environments)
            environments.join(trainer)
            trainer.train()

    What TRL calls an environment has a `failure`: the `Outcome` of a rollout that has failed, else
    None. After that its tools raise `EnvError`, and its reward and other attributes are None.

    Args:
        env: the class that TRL would take, or a `functools.partial` of it; its methods may be
            coroutine functions.
        num_envs: at least as many as a process has rollouts in a batch; more of them are spares.
        retries: how often a reset that has failed is tried again, on the env that was idle longest.
        fields: of the config entry; `step_timeout` limits tools.
    """

    def __init__(
        self, env: Callable[[], Any], num_envs: int, *, retries: int = 2, **fields: Any
    ) -> None:
        kind: Any = env.func if isinstance(env, functools.partial) else env
        tools = {
            name: _forwarded(name, function)
            for name, function in inspect.getmembers(kind, inspect.isfunction)
            if name != "reset" and not name.startswith("_")
        }
        self._type = type(kind.__name__, (_Environment,), tools)
        task = functools.partial(called_env, env)
        self._config = EnvConfig(name="trl", task=task, num_workers=num_envs, **fields)
        self._lending = LendingThread("envs of TRL", retries)

    def __enter__(self) -> Self:
        self._lending.open(self._config)
        return self

    def __exit__(self, *error: object) -> None:
        self._lending.close()

    def __call__(self) -> Any:
        """Make what TRL calls an environment."""
        return self._type(self._lending)

    def join(self, trainer: Any) -> None:
        """Have all envs of a batch of a `GRPOTrainer` reset at the same time.

        Without it they are reset one after another, as TRL asks for them.
        """
        name = "_generate_and_score_completions"  # The only place that sees a batch before that.
        generate, factories = getattr(trainer, name), trainer.environment_factories
        mine = [key for key, factory in factories.items() if factory is self]

        def together(inputs: list[dict[str, Any]]) -> Any:
            rows = inputs
            if mine != [None]:
                rows = [{**row} for row in inputs if row["environment"] in mine]
                rows = [row for row in rows if row.pop("environment")]
            self._lending.begin_all(rows)
            return generate(inputs)

        setattr(trainer, name, together)

    def metrics(self) -> dict[str, float]:
        """Return the numbers of the group, failures by kind among them: see `EnvGroup.metrics`."""
        return self._lending.metrics()


class _Environment:
    """What TRL calls an environment; subclasses have its tools."""

    def __init__(self, lending: LendingThread) -> None:
        self._lending = lending
        self._episode: Any = None
        self._failure: Outcome | None = None

    failure = property(lambda self: self._failure)

    def reset(self, **row: Any) -> Any:
        if self._episode is not None:
            self._lending.end(self._episode)
        found = self._lending.begin(row)
        is_there = isinstance(found, AttemptInPlay)
        self._episode, self._failure = (found, None) if is_there else (None, found)
        return found.first if is_there else None

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        try:
            return _forwarded("__getattribute__", object.__getattribute__)(self, name)
        except EnvError as error:
            raise AttributeError(str(error)) from None


def _forwarded(name: str, function: Any) -> Any:
    """Return a method that the env executes; TRL reads what `function` says."""

    @functools.wraps(function)
    def tool(self: Any, *args: Any, **kwargs: Any) -> Any:
        if self._episode is not None:
            try:
                step = self._lending.run(self._episode.step((name, args, kwargs)))
            except EnvFault as fault:
                self._lending.end(self._episode)
                self._episode, self._failure = None, fault.outcome
            else:
                answer, error = step.observation
                if error is None:
                    return answer
                raise EnvError(error, blame="either")  # TRL tells the model.
        if self._failure is None:
            raise RLightningError("it was not reset yet")
        if name in ("get_reward", "__getattribute__"):
            return None
        raise EnvError(self._failure.cause, blame=self._failure.blame)

    return tool
