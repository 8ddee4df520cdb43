"""Drake systems of the loop, for user diagrams."""

from stewart_drake.loop.controller import DelayLqiController, Reference, ServoController
from stewart_drake.loop.exact import ExactPlant
from stewart_drake.loop.link import DelayChain, LateMeasurements, PlayoutBuffer, VaryingDelay
from stewart_drake.loop.sensor import Encoders, Sensor
from stewart_drake.loop.servos import PositionServos, Servos
from stewart_drake.loop.tuner import AnnTuner, DensityWindow, LawTuner
from stewart_drake.scenario.timing import Delay

__all__ = [
    "AnnTuner",
    "Delay",
    "DelayChain",
    "DelayLqiController",
    "DensityWindow",
    "Encoders",
    "ExactPlant",
    "LateMeasurements",
    "LawTuner",
    "PlayoutBuffer",
    "Reference",
    "Sensor",
    "ServoController",
    "PositionServos",
    "Servos",
    "VaryingDelay",
]
