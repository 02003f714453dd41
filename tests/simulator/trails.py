"""Transitions that somebody stored: each must be one that its env can make, and none be missing.

An observation shows the whole state of its env, so a transition is checked by itself: the state
before it, stepped with the action, gives reward, ends and the state after it. A trail is all that
was stored of one env; it continues where the last transition led, or begins an episode.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from simulator.model import require
from simulator.scripted import Script, Words, mixed

if TYPE_CHECKING:
    from simulator.scripted import Act


class Transition(NamedTuple):
    """One step, as it was stored; `first` says that an episode begins with it."""

    before: Words
    act: Act
    reward: float
    terminated: bool
    truncated: bool
    after: Words
    first: bool | None = None


def script_at(words: Words, limit: float) -> Script:
    """An env in the state that it shows."""
    script = Script(words.code, limit)
    script.seed, script.episode, script.steps, script.mix = words.seed - 1, *words[2:]
    script.elapsed = words.step
    return script


def is_begun(words: Words) -> bool:
    """Return True if an env shows this after a reset."""
    code, seed, episode, step, mix = words
    return step == 0 and mix in [mixed(code, seed - 1, number, 0, 0) for number in (0, episode)]


class Trail:
    """All transitions of one env.

    Args:
        code: of the env.
        own_limit: steps after which its own wrapper truncates an episode.
        cut_after: steps after which `auto_reset` does.
        cut_together: that cuts several envs at once, of which each may have begun later.
        cut_or_ended: an episode that terminates is never truncated, too.

    Attributes:
        losses: how often its episode may still have been lost, or abandoned after an error; seen:
            how many of these were added.
        ended: return and length of each episode that ended.
    """

    def __init__(
        self,
        code: int,
        own_limit: float,
        cut_after: float = math.inf,
        *,
        cut_together: bool = False,
        cut_or_ended: bool = False,
    ) -> None:
        self.code, self.cut_together, self.cut_or_ended = code, cut_together, cut_or_ended
        self.own_limit, self.cut_after = own_limit, cut_after
        self.last: Transition | None = None
        self.losses = self.seen = 0
        # Return and length up to each state of the episode.
        self._sums: dict[Words, tuple[float, int]] = {}
        self.ended: list[tuple[float, int]] = []
        self._over: set[Words] = set()

    def allow(self, losses: int) -> None:
        """Note how many losses there may have been from the beginning on."""
        self.losses, self.seen = self.losses + losses - self.seen, losses

    @property
    def is_over(self) -> bool:
        return self.last is None or self.last.terminated or self.last.truncated

    def add(self, made: Transition, *, goes_on: bool = False) -> None:
        """Check one more; one that `goes_on` after an end belongs to no episode."""
        before, last = made.before, self.last
        require(before.code == self.code, "a transition of another env", made)
        has_ended = self._check_step(made)
        if goes_on:
            require(last is None or before == last.after, "it does not go on", last, made)
            self.last = made._replace(terminated=True)
            return
        if last is not None and not self.is_over and before == last.after and not made.first:
            pass
        else:
            require(before not in self._over, "it goes on after an end", last, made)
            self.losses -= not self.is_over
            require(self.losses >= 0, "an episode that is not over is cut", last, made)
            require(made.first is not False, "it continues nothing, and is not first", made)
            require(before.step == 0 and is_begun(before), "an invented state", last, made)
            if before not in self._sums:
                self._sums = {before: (0.0, 0)}
        total, length = self._sums[before]
        total, length = total + made.reward, length + 1
        self._sums[made.after] = total, length
        if made.terminated or made.truncated:
            self.ended.append((total, length))
        if has_ended:
            self._over.add(made.after)
        self.last = made

    def _check_step(self, made: Transition) -> bool:
        """Check a step by itself; return whether the env itself has ended its episode."""
        script = script_at(made.before, self.own_limit)
        reward, terminated, truncated, _ = script.step(*made.act)
        has_ended = terminated or truncated
        cut = script.steps >= self.cut_after
        if self.cut_together and self.cut_after < math.inf:
            # Not where all end by themselves in this step.
            cut = made.truncated or (cut and not has_ended)
        truncated |= cut
        if self.cut_or_ended:
            truncated &= not terminated
        require(script.words == made.after, f"it would lead to {script.words}", made)
        ends = np.float32(reward) == np.float32(made.reward), made.terminated, made.truncated
        require(ends == (True, terminated, truncated), "another reward, or another end", made)
        return has_ended
