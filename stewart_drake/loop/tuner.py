"""The tuner of the weights as a Drake system: of densities, or of what the law remembers."""

from typing import Any, NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    LeafSystem,
    State,
    ValueProducer,
)

from stewart_drake.loop.lifetime import weak
from stewart_drake.loop.sampling import Sample, update_every
from stewart_drake.scenario.signals import NUM_REFERENCE, NUM_STATE, WEIGHTS
from stewart_drake.tuner.density import NUM_INPUTS
from stewart_drake.tuner.network import Network
from stewart_drake.tuner.source import MAX_FACTOR, TunerMemory, WeightsSource, tune
from stewart_drake.types import Array


class AnnTuner(LeafSystem):
    """Sets w_Q and w_R at every sample by a network (III-D), within its bounds and a rate limit.

    With w the weights of the last sample, n the count of fallbacks, rho the densities of samples up
    to k - 1 and `tune` the law (`tuner.source.tune`):

    Initialise: w unknown, n = 0, then the update of k = 0.
    Update:     at k dt   (w, n) <- (w_k, n + fallback_k).
    Output:     weights = w_k, (w_k, fallback_k) = tune(rho, w), to be taken at the samples, before
                their updates; w_0 = fixed.

    Not finite in, or not finite out of the network: the weights go back towards `fixed`, and n
    counts it. The weights of sample k rest on data of samples up to k - 1, since the window takes
    in sample k, of which T_k is a part, in its update: there is no algebraic loop.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | density | input | 18 | - | read every period |
    | weights | output | 2 | w_Q, w_R | direct feedthrough |

    Args:
        network: what decides.
        fixed: (2,) w_Q and w_R at the first sample, and to fall back to.
        period: dt in s.
        factor: by which a weight changes at most from one sample to the next.
    """

    def __init__(
        self, network: Network, fixed: Array, period: float, factor: float = MAX_FACTOR
    ) -> None:
        super().__init__()
        self._network, self._fixed, self._factor = network, np.array(fixed), factor
        size = len(WEIGHTS)
        self._last = self.DeclareDiscreteState(np.full(size, np.nan))
        self._count = self.DeclareDiscreteState(1)
        self._density = self.DeclareVectorInputPort("density", NUM_INPUTS)
        self._step = self.DeclareCacheEntry(
            "step",
            ValueProducer(
                allocate=lambda: Value((np.array(fixed), False)), calc=weak(self._calc_step)
            ),
            {self._density.ticket(), self.discrete_state_ticket(self._last)},
        )
        self.DeclareVectorOutputPort("weights", size, weak(self._weights), {self._step.ticket()})
        update_every(self, period, self._update)

    def fallbacks(self, context: Context) -> int:
        """Samples so far at which the network had to be passed over."""
        return int(context.get_discrete_state(self._count).value()[0])

    def _calc_step(self, context: Context, result: AbstractValue) -> None:
        last = context.get_discrete_state(self._last).value()
        densities = np.asarray(self._density.Eval(context))
        result.set_value(tune(self._network, densities, last, self._fixed, self._factor))

    def _weights(self, context: Context, output: BasicVector) -> None:
        step: Any = self._step.Eval(context)
        output.SetFromVector(step[0])

    def _update(self, context: Context, state: State) -> None:
        step: Any = self._step.Eval(context)
        weights, fell_back = step
        state.get_mutable_discrete_state(self._last).SetFromVector(weights)
        count = self.fallbacks(context) + fell_back
        state.get_mutable_discrete_state(self._count).SetFromVector([count])


class Remembered(NamedTuple):
    """A tuner's memory in a Context."""

    memory: TunerMemory

    def __deepcopy__(self, memo: dict[int, Any]) -> "Remembered":
        """Drake copies what it keeps; nobody changes a memory, so that itself will do."""
        return self


class LawTuner(LeafSystem):
    """Sets w_Q and w_R at every sample by what the law remembers.

    With m the tuner's memory and `decide` and `observe` those of a tuner (`tuner.source`):

    Initialise: m of a law before its first sample, then the update of k = 0.
    Update:     at k dt   m <- observe(m, decide(m), what the law remembers since k, reference).
    Output:     weights = decide(m), hence of samples up to k - 1 until k dt.

    The law's memory since sample k rests on the weights of sample k, and these on m alone: there is
    no algebraic loop.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | memory | input | abstract, `loop.sampling.Sample` | - | read every period |
    | reference | input | 18 | rad, m and time derivatives | read every period |
    | weights | output | 2 | w_Q, w_R | held |

    Args:
        source: the tuner.
        first: what the law remembers before its first sample.
        period: dt in s.
    """

    def __init__(self, source: WeightsSource, first: Sample, period: float) -> None:
        super().__init__()
        self._source = source
        start = Remembered(source.start(first.memory))
        self._kept = self.DeclareAbstractState(Value(start))
        self._memory = self.DeclareAbstractInputPort("memory", Value(first))
        self._reference = self.DeclareVectorInputPort("reference", NUM_REFERENCE)
        ticket = self.abstract_state_ticket(self._kept)
        self.DeclareVectorOutputPort("weights", len(WEIGHTS), weak(self._weights), {ticket})
        update_every(self, period, self._update)

    def memory(self, context: Context) -> TunerMemory:
        """What the tuner remembers in a context of this system."""
        value: Any = context.get_abstract_state(int(self._kept))
        return value.get_value().memory

    def fallbacks(self, context: Context) -> int:
        """Samples so far at which who decides had to be passed over."""
        return self.memory(context).fallbacks

    def _weights(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._source.decide(self.memory(context)).weights)

    def _update(self, context: Context, state: State) -> None:
        memory = self.memory(context)
        sample: Any = self._memory.Eval(context)
        wanted = np.asarray(self._reference.Eval(context))[:NUM_STATE]
        decision = self._source.decide(memory)
        after = self._source.observe(memory, decision, sample.memory, wanted)
        state.get_mutable_abstract_state(int(self._kept)).set_value(Remembered(after))
