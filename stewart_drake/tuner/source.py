"""Weights of the law at run time, by core/tuner.c: features, policy, and memory in, memory out.

A tuner keeps a window of rows, one for each of the last 31 samples. Its features are the paper's
densities (45), or `health`, which relates timing, surprise, error and feedback to their usual size
(NAMES). Densities divide each signal by its own mean, so that no scale survives in them.

Weights move along the ratio r = log10(w_Q / w_R), on which alone the gain depends, with
w_Q w_R = 1. From one sample to the next r falls by 0.35 at the most and rises by 0.15: caution is
needed at once, and is given up slowly. The paper's network moves each weight by a factor instead,
of at most 1.5.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple, get_args

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.files.arguments import one_of
from stewart_drake.law.compiled import Compiled, machine_of, numbers
from stewart_drake.law.memory import Memory
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.tuner.network import NUM_INPUTS, WINDOW, Kind, Network
from stewart_drake.types import Array, ArrayLike

NAMES: Final = (
    "timing_31", "timing_10", "timing_bound", "timing_detectable",
    "error_10", "error_31", "feedback_4", "feedback_20", "surprise_3", "surprise_15",
    "surprise_of_tolerance", "surprise_peak", "ratio", "noise", "delay", "doubt",
    "feedback_change", "feedback_growth",
)  # fmt: skip
"""Features `health`; a number is that of the samples of a root mean square."""
_MATRICES: Final = ("input_mean", "input_scale", "W1", "b1", "W2", "b2")


def ratio_of(weights: Array) -> float:
    """Return log10(w_Q / w_R)."""
    return float(np.log10(weights[0] / weights[1]))


def weights_of(ratio: float) -> Array:
    """Return w_Q and w_R (2,) of a ratio, with w_Q w_R = 1."""
    return np.array([10 ** (ratio / 2), 10 ** (-ratio / 2)])


@dataclass(frozen=True)
class DensityFeatures:
    """The paper's densities (45), see `tuner.network`."""

    kind: Kind = "magnitude"

    def __post_init__(self) -> None:
        one_of("kind", self.kind, get_args(Kind))


@dataclass(frozen=True)
class HealthFeatures:
    """The features NAMES of a law that measures the state."""

    noise: Array  # (12,) standard deviation of a measurement
    motion: Array  # (12,) half the peak to peak of the reference, and the same per second
    tolerance: Array  # (12,) tolerable error of the pose, and per second of the rates
    torque: float  # largest that the reference takes, N m
    prior: Array | None  # (p,) standard deviations of the estimated parameters, or None
    delay: float  # assumed delay times the reference's angular frequency


@dataclass(frozen=True)
class FixedPolicy:
    first: Array  # (2,) w_Q and w_R


@dataclass(frozen=True)
class PaperPolicy:
    """The paper's network, whose output is clipped to its bounds, then limited in rate.

    Weights are scales, so the rate is a factor. The gain, which depends on w_Q / w_R, changes with
    its square at most. Where the network fails, the weights return to `first` at the same rate.
    """

    network: Network
    first: Array  # (2,) weights at the start, and to return to


@dataclass(frozen=True)
class RatioPolicy:
    """A network with a start, to which it returns where it fails."""

    network: Network

    @property
    def first(self) -> Array:
        assert self.network.start is not None
        return self.network.start


@dataclass(frozen=True)
class Rule:
    """A constant ratio as long as predictions hold, and a falling one where they do not.

        r = ratio - slope max(0, x - knee),

    x = log10(nu + 0.1), nu the largest innovation of the last 31 samples over its floor (root mean
    square of the twelve values), the feature `surprise_peak`.
    """

    ratio: float
    slope: float
    knee: float

    @property
    def first(self) -> Array:
        return weights_of(self.ratio)


class Decision(NamedTuple):
    """Weights (2,) of a sample, finite and above zero; and whether the policy failed."""

    weights: Array
    fell_back: bool


class TunerMemory(NamedTuple):
    """Memory of a tuner: numbers of the core, and the memory of the law."""

    data: Array
    law: Memory

    @property
    def fallbacks(self) -> int:
        """Samples at which the policy failed."""
        return int(self.data[2])


@dataclass(frozen=True)
class WeightsSource:
    """A tuner for one law."""

    plant: NominalPlant | None  # model of the plant in the law, for `health`
    features: DensityFeatures | HealthFeatures  # input of the policy
    policy: FixedPolicy | PaperPolicy | RatioPolicy | Rule  # gives the weights

    @cached_property
    def compiled(self) -> Compiled:
        """The `stewart_tuner`."""
        c, features, policy = core(), self.features, self.policy
        it = c.ffi.new("stewart_tuner *")
        if isinstance(features, DensityFeatures):
            it.is_signed = features.kind == "signed"
        else:
            it.health, it.torque, it.delay = 1, features.torque, features.delay
            for name in ("noise", "motion", "tolerance"):
                setattr(it, name, getattr(features, name).tolist())
            if features.prior is not None:
                it.doubts, it.prior[0 : len(features.prior)] = 1, features.prior.tolist()
        it.first = policy.first.tolist()
        if isinstance(policy, FixedPolicy):
            it.policy = c.lib.STEWART_FIXED_WEIGHTS
            return Compiled(it)
        if isinstance(policy, Rule):
            it.policy = c.lib.STEWART_RULE
            it.ratio, it.slope, it.knee = policy.ratio, policy.slope, policy.knee
            return Compiled(it)
        paper, network = isinstance(policy, PaperPolicy), policy.network
        it.policy = c.lib.STEWART_PAPER_NETWORK if paper else c.lib.STEWART_RATIO_NETWORK
        it.hidden, it.logarithms = network.hidden, network.output == "log_weights"
        it.bounds = np.ravel(network.bounds).tolist()
        kept = tuple(numbers(getattr(network, name)) for name in _MATRICES)
        for name, array in zip(_MATRICES, kept, strict=True):
            setattr(it, name, c.at(array))
        return Compiled(it, kept)

    def start(self, law: Memory) -> TunerMemory:
        """Return the memory before the first sample of a law."""
        it, c = self.compiled.pointer, core()
        memory = np.empty(c.lib.stewart_tuner_memory(it))
        c.lib.stewart_tuner_start(it, c.at(memory))
        return TunerMemory(memory, law)

    def decide(self, memory: TunerMemory) -> Decision:
        """Return the weights of the next sample, from data up to the last one."""
        weights, c = np.empty(2), core()
        fell_back = c.lib.stewart_decide(self.compiled.pointer, c.at(memory.data), c.at(weights))
        return Decision(weights, bool(fell_back))

    def decide_by(self, values: Array, last: Array) -> Decision:
        """Return the weights from features (18,) and the weights (2,) of the sample before."""
        weights, c = np.empty(2), core()
        given = map(c.at, (numbers(values), numbers(last), weights))
        return Decision(weights, bool(c.lib.stewart_decide_by(self.compiled.pointer, *given)))

    def values(self, window: Array) -> Array:
        """Return the features (18,) of a window (31, columns), NaN before the first sample."""
        found, c = np.empty(NUM_INPUTS), core()
        c.lib.stewart_tuner_features(self.compiled.pointer, c.at(numbers(window)), c.at(found))
        return found

    def row(self, memory: TunerMemory) -> Array:
        """Return the newest row of the window."""
        return np.reshape(memory.data[3:], (WINDOW, -1))[-1]

    def observe(
        self, memory: TunerMemory, decision: Decision, after: Memory, wanted: Array
    ) -> TunerMemory:
        """Take a sample into the memory.

        `after` is the memory of the law after it; `wanted` (12,) are pose and rates of the
        reference.
        """
        c, before, data = core(), memory.law, memory.data.copy()
        belief, measured = before.belief, after.measurement
        if len(measured) != NUM_STATE:
            measured = after.belief.state
        schedule, following = belief.timeline.last_period(before.in_flight)
        arrays: dict[str, Any] = {
            "state": belief.state,
            "theta": belief.parameters,
            "following": following,
            "measured": measured,
            "std": after.belief.estimate.parameter_std,
        }
        kept = {name: numbers(value) for name, value in arrays.items()}
        acted = [numbers(part) for part in schedule]
        torques, feedforwards = (
            [numbers(getattr(one, name)) for one in (after, before)]
            for name in ("torque", "feedforward")
        )
        given = c.ffi.new(
            "stewart_tuner_input *",
            {
                "machine": c.ffi.NULL if self.plant is None else machine_of(self.plant).pointer,
                "schedule": [len(acted[0]), *map(c.at, acted), 0],
                "torque": [*map(c.at, torques)],
                "feedforward": [*map(c.at, feedforwards)],
                **{name: c.at(value) for name, value in kept.items()},
            },
        )
        weights, reference = numbers(decision.weights), numbers(wanted)
        c.lib.stewart_tuner_observe(
            *(self.compiled.pointer, c.at(data), given, c.at(reference), c.at(weights)),
            *(decision.fell_back, c.scratch(NUM_STATE * len(acted[0]))),
        )
        return TunerMemory(data, after)


def densities(samples: ArrayLike, kind: Kind = "magnitude") -> Array:
    """Return equation (45) along a record (N, 18) of samples in time order.

    A sample is [measurement - reference (12); commanded torque (6)] in rad, m, rad/s, m/s and N m;
    values that are not finite are unknown. Row k is of samples max(0, k - WINDOW + 1) to k.
    """
    record = np.asarray(samples, dtype=np.float64)
    if record.ndim != 2 or record.shape[1] != NUM_INPUTS:
        raise ValueError(f"samples: got shape {record.shape}; expected (N, {NUM_INPUTS})")
    values = density_source(kind).values
    padded = np.vstack([np.full((WINDOW - 1, NUM_INPUTS), np.nan), record])
    rho = [values(padded[k : k + WINDOW]) for k in range(len(record))]
    return np.reshape(rho, record.shape)


def density_source(kind: Kind) -> WeightsSource:
    return WeightsSource(None, DensityFeatures(kind), FixedPolicy(np.ones(2)))
