"""The control law, composed of small parts: state in, state out, no LeafSystem."""

from stewart_drake.law.channel import Channel, Packets, Wire
from stewart_drake.law.cost import QuadraticCost
from stewart_drake.law.feedforward import (
    EquilibriumFeedforward,
    Feedforward,
    InverseDynamicsFeedforward,
    NoFeedforward,
)
from stewart_drake.law.memory import Memory
from stewart_drake.law.motion import KnownMotion
from stewart_drake.law.nominal import (
    DesignModel,
    MultibodyModel,
    NominalPlant,
    PaperModel,
    TorqueLimit,
)
from stewart_drake.law.observers import CoreObserver, DelaySettings, Observer
from stewart_drake.law.planner import NoPlanner, Planner, Replan
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.predictors import (
    ArrivalPredictor,
    LinearPredictor,
    NonlinearPredictor,
    Predictor,
)
from stewart_drake.law.sensing import EncoderSensing, Measurement, Sensing, StateSensing
from stewart_drake.law.servos import ServoPreview
from stewart_drake.law.timeline import Arrivals, Timeline

__all__ = [
    "ArrivalPredictor",
    "Arrivals",
    "Channel",
    "CoreObserver",
    "DelaySettings",
    "DesignModel",
    "EncoderSensing",
    "EquilibriumFeedforward",
    "Feedforward",
    "InverseDynamicsFeedforward",
    "KnownMotion",
    "LinearPredictor",
    "Measurement",
    "Memory",
    "MultibodyModel",
    "NoFeedforward",
    "NoPlanner",
    "NominalPlant",
    "NonlinearPredictor",
    "Observer",
    "Packets",
    "PaperModel",
    "Planner",
    "PredictiveLqi",
    "Predictor",
    "QuadraticCost",
    "Replan",
    "Sensing",
    "ServoPreview",
    "StateSensing",
    "Timeline",
    "TorqueLimit",
    "Wire",
]
