"""Memory of the control law from one sample to the next."""

from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.law.belief import Belief
from stewart_drake.law.channel import Packets, Sent
from stewart_drake.law.counts import Counts
from stewart_drake.law.observers import belief_of
from stewart_drake.scenario.signals import NUM_COORDINATES, NUM_TORQUES, WEIGHTS
from stewart_drake.types import Array

_OF_TORQUES: Final = {"integral": NUM_COORDINATES, "weights": len(WEIGHTS)}
"""Sizes of fields that are NaN in a law for servos."""


@dataclass(frozen=True)
class Memory:
    """Memory of a law. Its other names are the fields of `stewart_layout`, see core/law.h."""

    data: Array  # (n,) all fields
    compiled: Any  # `law.core_law.CompiledLaw` of the law
    own: dict[str, Any]  # memories of parts in Python

    @property
    def law(self) -> Any:
        return self.compiled.law

    def field(self, name: str) -> Array:
        """Return a field: (columns,) of one row, else (rows, columns)."""
        at, rows, columns = self.compiled.fields[name]
        values = self.data[at : at + rows * columns]
        return values if rows == 1 else values.reshape(rows, columns)

    @property
    def in_flight(self) -> Array:
        """Torques (n, 6) within the limit, oldest first."""
        return self.field("in_flight").reshape(-1, NUM_TORQUES)

    def __getattr__(self, name: str) -> Array:
        if name in _OF_TORQUES and name not in self.compiled.fields:
            return np.full(_OF_TORQUES[name], np.nan)
        if name.startswith("_") or name not in self.compiled.fields:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return self.field(name)

    @property
    def gain(self) -> Array:
        """Last good feedback gain (6, g), NaN before the first."""
        values, law = self.field("gain").ravel(), self.law
        known = int(np.isfinite(values).sum())  # fewer under a shorter delay
        if known == 0:
            pending = law.predictor.pending(law.timeline)
            order = core().lib.stewart_order([self.compiled.data.cost], pending)
            known = NUM_TORQUES * order
        return values[:known].reshape(NUM_TORQUES, -1)

    @property
    def plan(self) -> Array:
        """(N, 6) torques that were sent last."""
        channel = self.law.channel
        if isinstance(channel, Packets):
            return self.sent.packets[-1, channel.repeats :]
        plan: Array = self.own.get("plan", self.in_flight[-1:])
        return plan

    @property
    def sent(self) -> Sent:
        channel = self.law.channel
        if isinstance(channel, Packets):
            return Sent(self.field("channel"), len(channel.in_time))
        sent: Sent = self.own.get("channel", Sent(np.zeros(1)))
        return sent

    @property
    def open_loop_samples(self) -> int:
        """Samples that remain without feedback."""
        return int(self.field("open_loop_samples")[0])

    @cached_property
    def counts(self) -> Counts:
        return Counts(*(int(count) for count in self.field("counts")))

    @cached_property
    def belief(self) -> Belief:
        """State now, with the covariance at the last measurement."""
        belief: Belief | None = self.own.get("observer")
        if belief is None:
            given = self.compiled.torques_law, self.field("observer"), self.law.timeline
            belief = belief_of(self.law.observer, *given)
        return belief.at(self.field("state"))

    def copy(self) -> "Memory":
        return replace(self, data=self.data.copy(), own=deepcopy(self.own))

    def without_error(self) -> "Memory":
        """Return the memory with error and integral reset."""
        after = self.copy()
        after.field("error")[:] = after.field("integral")[:] = 0.0
        return after
