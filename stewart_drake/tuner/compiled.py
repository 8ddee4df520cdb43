"""The tuners of this room as core/tuner.h has them."""

from typing import Any, Final

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.law.compiled import Compiled, numbers
from stewart_drake.tuner.features import DensityFeatures, HealthFeatures
from stewart_drake.tuner.network import Network
from stewart_drake.tuner.source import PaperPolicy, RatioPolicy, Rule, WeightsSource

_MATRICES: Final = ("input_mean", "input_scale", "W1", "b1", "W2", "b2")


def compiled_tuner(source: WeightsSource) -> Compiled | None:
    """Return the `stewart_tuner` of a tuner, or None for features or a policy of one's own."""
    tuner, features, policy = core().ffi.new("stewart_tuner *"), source.features, source.policy
    if type(features) is HealthFeatures:
        _health(tuner, features)
    elif type(features) is DensityFeatures:
        tuner.is_signed = features.kind == "signed"
    else:
        return None
    if not isinstance(policy, PaperPolicy | RatioPolicy | Rule):
        return None
    tuner.first = policy.first.tolist()
    if isinstance(policy, Rule):
        tuner.policy = core().lib.STEWART_RULE
        tuner.ratio, tuner.slope, tuner.knee = policy.ratio, policy.slope, policy.knee
        return Compiled(tuner)
    kind = "STEWART_PAPER_NETWORK" if isinstance(policy, PaperPolicy) else "STEWART_RATIO_NETWORK"
    tuner.policy = getattr(core().lib, kind)
    return Compiled(tuner, _network(tuner, policy.network))


def _health(tuner: Any, features: HealthFeatures) -> None:
    tuner.health = 1
    for name in ("noise", "motion", "tolerance"):
        setattr(tuner, name, getattr(features, name).tolist())
    tuner.torque, tuner.delay = features.torque, features.delay
    if features.prior is not None:
        tuner.doubts = 1
        for i, std in enumerate(features.prior):
            tuner.prior[i] = std


def _network(tuner: Any, network: Network) -> tuple[Any, ...]:
    tuner.hidden, tuner.logarithms = network.hidden, network.output == "log_weights"
    tuner.bounds = np.ravel(network.bounds).tolist()
    kept = tuple(numbers(getattr(network, name)) for name in _MATRICES)
    for name, array in zip(_MATRICES, kept, strict=True):
        setattr(tuner, name, core().at(array))
    return kept
