"""The tuner that a scenario asks for, made of features and a policy; here it is chosen."""

from typing import Final

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.law.delay_observer import DelayObserver
from stewart_drake.law.late import LateObserver
from stewart_drake.law.observers import ParameterObserver
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.sensing import StateSensing
from stewart_drake.law.startup import INSTANTS, TOLERANCE, least_torque, reference_torque
from stewart_drake.loop.experiment import Experiment, motion_scale
from stewart_drake.scenario.config import RuleTunerConfig
from stewart_drake.scenario.signals import RATES
from stewart_drake.scenario.trajectories import evaluate, spread_instants
from stewart_drake.tuner.features import DensityFeatures, Features, HealthFeatures
from stewart_drake.tuner.source import PaperPolicy, RatioPolicy, Rule, WeightsSource

RULES: Final = {True: Rule(-1.77, 2.35, 0.41), False: Rule(-0.82, 1.37, 0.33)}
"""Usual rule of a controller with an estimator, and of one without."""


def weights_source(experiment: Experiment, law: PredictiveLqi) -> WeightsSource | None:
    """Features and policy of a scenario's tuner, or None where weights are fixed.

    Raises:
        ConfigError: what it decides by takes a state that is measured, without delay.
    """
    sc, network = experiment.scenario, experiment.network
    c = sc.controller
    if isinstance(sc.tuner, RuleTunerConfig):
        usual, own = RULES[bool(c.estimate)], sc.tuner
        rule = Rule(
            usual.ratio if own.ratio is None else own.ratio,
            usual.slope if own.slope is None else own.slope,
            usual.knee if own.knee is None else own.knee,
        )
        return WeightsSource(health_of(experiment, law), rule)
    if network is None:
        return None
    features: Features = DensityFeatures(network.density)
    if network.features == "health":
        features = health_of(experiment, law)
    if network.start is None:
        return WeightsSource(features, PaperPolicy(network, np.array([c.w_Q, c.w_R])))
    return WeightsSource(features, RatioPolicy(network))


def health_of(experiment: Experiment, law: PredictiveLqi) -> HealthFeatures:
    """The features `health` of a law.

    Raises:
        ConfigError: it does not measure the state, or late.
    """
    sc = experiment.scenario
    sensing = law.sensing
    if not isinstance(sensing, StateSensing) or isinstance(law.observer, LateObserver):
        raise ConfigError(
            f"tuner.kind: got {sc.tuner.kind!r}, which goes by the law's predictions, with "
            f"sensor.kind {sc.sensor.kind!r} and a sensor.delay of {sc.sensor.delay:g} s; expected "
            "'fixed', or measurements of the state, of now"
        )
    motion = np.tile(motion_scale(experiment), 2)
    nominal, reference = experiment.nominal, experiment.reference
    torque = max(least_torque(nominal), reference_torque(nominal, reference, sc.duration))
    observer, prior = law.observer, None
    if isinstance(observer, ParameterObserver | DelayObserver):
        prior = observer.settings.parameters.std
    return HealthFeatures(
        plant=law.plant,
        noise=np.array(sensing.noise_std),
        motion=motion,
        tolerance=TOLERANCE * motion,
        torque=torque,
        prior=prior,
        delay=law.timeline.eta * angular_frequency(experiment),
    )


def angular_frequency(experiment: Experiment) -> float:
    """rad/s, of the reference: its largest rate over half its peak to peak; of a sine its own."""
    times = spread_instants(experiment.scenario.duration, INSTANTS)
    rates = np.array([evaluate(experiment.reference, t)[RATES] for t in times])
    return float((np.abs(rates).max(axis=0) / motion_scale(experiment)).max())
