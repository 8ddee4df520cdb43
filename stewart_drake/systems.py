"""Drake systems of the loop, for diagrams of one's own."""

from stewart_drake.loop.controller import DelayLqiController
from stewart_drake.loop.delay_chain import DelayChain
from stewart_drake.loop.exact import ExactPlant
from stewart_drake.loop.playout import PlayoutBuffer
from stewart_drake.loop.reference import Reference
from stewart_drake.loop.sensor import Encoders, LateMeasurements, Sensor
from stewart_drake.loop.servo_design import ServoController
from stewart_drake.loop.servos import Servos
from stewart_drake.loop.tuner import AnnTuner, DensityWindow, LawTuner
from stewart_drake.loop.varying_delay import VaryingDelay

__all__ = [
    "AnnTuner",
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
    "Servos",
    "VaryingDelay",
]
