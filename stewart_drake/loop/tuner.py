"""The tuner of the weights: its features, its policy, and its Drake systems."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context

from stewart_drake.files import arguments
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.observers import CoreObserver
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.sensing import StateSensing
from stewart_drake.law.startup import INSTANTS, TOLERANCE, least_torque, reference_torque
from stewart_drake.loop.preparation import Experiment
from stewart_drake.loop.sampling import Sample, SteppedLaw
from stewart_drake.mechanism.trajectories import rows_along, spread_instants
from stewart_drake.scenario.signals import NUM_REFERENCE, NUM_STATE, NUM_TORQUES, RATES, WEIGHTS
from stewart_drake.tuner.network import NUM_INPUTS, WINDOW, Kind, Network, load_network
from stewart_drake.tuner.source import (
    DensityFeatures,
    HealthFeatures,
    PaperPolicy,
    RatioPolicy,
    Rule,
    TunerMemory,
    WeightsSource,
    density_source,
)
from stewart_drake.types import Array


class DensityWindow(SteppedLaw):
    """Window of the last 31 samples, with its densities, equation (45).

    With s_k = [y_k - r_k; T_k], y the measured or else the estimated state, r the reference's pose
    and rates, T_k the torque computed at t = k dt:

    Initialise: window = [unknown, ..., unknown], then the update of k = 0.
    Update:     at k dt   window <- [window without its oldest; s_k].
    Output:     density = (45) of the window, hence of samples up to k from k dt on.

    Values of s_k that are not finite are left out of the window's mean. While the window fills, the
    mean is over the samples so far. The update is early and unrestricted like the controller's, so
    that T_k is the torque of the same step that the link takes.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | measurement | input | 12 | rad, m, rad/s, m/s | read every period |
    | reference | input | 18 | rad, m and time derivatives | read every period |
    | torque | input | 6 | N m | read every period |
    | density | output | 18 | - | held, NaN before the first sample |

    Args:
        period: dt in s.
        kind: of density, `magnitude` or `signed`.
    """

    def __init__(self, period: float, kind: Kind = "magnitude") -> None:
        super().__init__()
        density = density_source(kind).values
        self._measurement = self.DeclareVectorInputPort("measurement", NUM_STATE)
        self._reference = self.DeclareVectorInputPort("reference", NUM_REFERENCE)
        self._torque = self.DeclareVectorInputPort("torque", NUM_TORQUES)
        self._begin(np.full((WINDOW, NUM_INPUTS), np.nan), period)

        def densities(window: Array) -> Array:
            return density(window) if np.isfinite(window).any() else window[-1]

        self._put_out("density", NUM_INPUTS, densities)

    def window(self, context: Context) -> Array:
        """Return the samples (31, 18) in a context, the newest last, NaN where unknown."""
        window: Array = self.sample(context).memory
        return window

    def _prepared(self, context: Context) -> Callable[[], Array]:
        target = np.asarray(self._reference.Eval(context))[:NUM_STATE]
        error = np.asarray(self._measurement.Eval(context)) - target
        sample = np.concatenate([error, self._torque.Eval(context)])
        window = self.window(context)
        return lambda: np.vstack([window[1:], sample])


class AnnTuner(SteppedLaw):
    """Sets w_Q and w_R at every sample by a network (III-D), within its bounds and a rate limit.

    With w the weights of the last sample, n the count of fallbacks, rho the densities of samples up
    to k - 1 and `tune` the law (`tuner.source.PaperPolicy`):

    Initialise: w unknown, n = 0, then the update of k = 0.
    Update:     at k dt   (w, n) <- (w_k, n + fallback_k).
    Output:     weights = w_k, (w_k, fallback_k) = tune(rho, w), to be read at the samples, before
                their updates; w_0 = fixed.

    If input or output of the network is not finite, the weights return towards `fixed`, and n
    counts it. The weights of sample k depend on samples up to k - 1: the window takes sample k and
    T_k in its update, without an algebraic loop.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | density | input | 18 | - | read every period |
    | weights | output | 2 | w_Q, w_R | direct feedthrough |

    Args:
        network: with densities for features, or its shipped name or file; its `density` is the kind
            of the `DensityWindow`.
        fixed: (2,) w_Q and w_R at the first sample and after fallbacks.
        period: dt in s.
    """

    def __init__(self, network: Network | str | Path, fixed: Array, period: float) -> None:
        super().__init__()
        if isinstance(network, str | Path):
            network = load_network(network)
        arguments.of_kind("network", network, Network)
        arguments.one_of("network.features", network.features, ("densities",))
        first = arguments.fixed("fixed", fixed, (len(WEIGHTS),), 0.0)
        policy = PaperPolicy(network, first)
        self._source = WeightsSource(None, DensityFeatures(network.density), policy)
        self._density = self.DeclareVectorInputPort("density", NUM_INPUTS)
        self._begin((np.full(len(WEIGHTS), np.nan), 0), period)
        self._put_out("weights", len(WEIGHTS), lambda memory: memory[0], now=True)

    def fallbacks(self, context: Context) -> int:
        return int(self.sample(context).memory[1])

    def _prepared(self, context: Context) -> Callable[[], tuple[Array, int]]:
        last, count = self.sample(context).memory
        densities = np.asarray(self._density.Eval(context))

        def step() -> tuple[Array, int]:
            if np.isnan(last).any():
                return self._source.policy.first, count
            weights, fell_back = self._source.decide_by(densities, last)
            return weights, count + fell_back

        return step


class LawTuner(SteppedLaw):
    """Sets w_Q and w_R at every sample by the memory of the law.

    With m the tuner's memory and `decide` and `observe` those of a tuner (`tuner.source`):

    Initialise: m of a law before its first sample, then the update of k = 0.
    Update:     at k dt   m <- observe(m, decide(m), memory of the law at k, reference).
    Output:     weights = decide(m), hence of samples up to k - 1 until k dt.

    The law's memory at sample k follows from the weights of sample k, and these from m alone,
    without an algebraic loop.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | memory | input | abstract, `loop.sampling.Sample` | - | read every period |
    | reference | input | 18 | rad, m and time derivatives | read every period |
    | weights | output | 2 | w_Q, w_R | held |

    Args:
        first: memory of the law before its first sample.
        period: dt in s.
    """

    def __init__(self, source: WeightsSource, first: Sample, period: float) -> None:
        super().__init__()
        self._source = source
        self._memory = self.DeclareAbstractInputPort("memory", Value(first))
        self._reference = self.DeclareVectorInputPort("reference", NUM_REFERENCE)
        self._begin(source.start(first.memory), period)
        self._put_out("weights", len(WEIGHTS), lambda memory: source.decide(memory).weights)

    def fallbacks(self, context: Context) -> int:
        return int(self.sample(context).memory.fallbacks)

    def _prepared(self, context: Context) -> Callable[[], TunerMemory]:
        memory, source = self.sample(context).memory, self._source
        sample: Any = self._memory.Eval(context)
        wanted = np.asarray(self._reference.Eval(context))[:NUM_STATE]
        return lambda: source.observe(memory, source.decide(memory), sample.memory, wanted)


RULES: Final = {True: Rule(-1.77, 2.35, 0.41), False: Rule(-0.82, 1.37, 0.33)}
"""Default rule of a controller with an estimator, and without."""


def weights_source(experiment: Experiment, law: PredictiveLqi) -> WeightsSource | None:
    """Make features and policy of a scenario's tuner, None for fixed weights."""
    config, c = experiment.scenario.tuner, experiment.scenario.controller
    if config.kind == "fixed":
        return None
    if config.kind == "rule":
        given = {name: getattr(config, name) for name in ("ratio", "slope", "knee")}
        own = {name: value for name, value in given.items() if value is not None}
        rule = replace(RULES[bool(c.estimate)], **own)
        return WeightsSource(law.plant, health_of(experiment, law), rule)
    network = experiment.network
    assert network is not None
    features: DensityFeatures | HealthFeatures = DensityFeatures(network.density)
    if network.features == "health":
        features = health_of(experiment, law)
    if network.start is None:
        return WeightsSource(law.plant, features, PaperPolicy(network, np.array(c.weights)))
    return WeightsSource(law.plant, features, RatioPolicy(network))


def health_of(experiment: Experiment, law: PredictiveLqi) -> HealthFeatures:
    sc = experiment.scenario
    sensing = law.sensing
    if not isinstance(sensing, StateSensing) or law.longest_wait:
        raise ConfigError(
            f"tuner.kind: got {sc.tuner.kind!r}, which uses the law's predictions, with "
            f"sensor.kind {sc.sensor.kind!r} and a sensor.delay of {sc.sensor.delay:g} s; expected "
            "'fixed', or measurements of the present state"
        )
    motion = np.tile(experiment.motion_scale, 2)
    nominal, reference = experiment.nominal, experiment.reference
    torque = max(least_torque(nominal), reference_torque(nominal, reference, sc.duration))
    observer, prior = law.observer, None
    if isinstance(observer, CoreObserver) and observer.settings is not None:
        prior = observer.settings.parameters.std
    return HealthFeatures(
        noise=np.array(sensing.noise_std),
        motion=motion,
        tolerance=TOLERANCE * motion,
        torque=torque,
        prior=prior,
        delay=law.timeline.eta * angular_frequency(experiment),
    )


def angular_frequency(experiment: Experiment) -> float:
    """Return the largest rate of the reference over half its peak to peak, rad/s."""
    times = spread_instants(experiment.scenario.duration, INSTANTS)
    rates = rows_along(experiment.reference, times)[:, RATES]
    return float((np.abs(rates).max(axis=0) / experiment.motion_scale).max())
