"""The structures of plant.c, field by field, and its functions."""

import ctypes
from ctypes import POINTER, Structure, c_double, c_int, c_long, c_void_p
from enum import IntEnum
from typing import Final

from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES

_Numbers = POINTER(c_double)
_Six = c_double * NUM_TORQUES


class Ended(IntEnum):
    """How a run has ended."""

    INSIDE = 0
    LEFT = 1
    TOO_SHORT_STEPS = 2
    CONTROLLER_FAILED = 3


class DriveStruct(Structure):
    """`drive`."""

    _fields_ = (
        ("constant", _Six),
        ("amplitude", _Six),
        ("phase", _Six),
        ("frequency", c_double),
    )


class MachineStruct(Structure):
    """`machine`: addresses within packed buffers."""

    _fields_ = (
        ("change", c_void_p),
        ("torque", c_void_p),
        ("slope", c_void_p),
        ("margin", c_void_p),
        ("above", c_void_p),
        ("sine", c_void_p),
    )


class LooksStruct(Structure):
    """`looks`."""

    _fields_ = (("time", c_void_p), ("state", c_void_p), ("number", c_long), ("seen", c_long))


class RunStruct(Structure):
    """`run`."""

    _fields_ = (
        ("tolerance", c_double),
        ("longest", c_double),
        ("end", c_double),
        ("time", c_double),
        ("state", c_double * NUM_STATE),
        ("steps", c_long),
        ("evaluations", c_long),
    )


class LoopStruct(Structure):
    """`loop`."""

    _fields_ = (
        ("samples", c_long),
        ("sampled", c_void_p),
        ("period", c_double),
        ("delays", c_void_p),
        ("link", c_void_p),
        ("memory", c_void_p),
        ("noise", c_void_p),
        ("bias", _Six),
        ("measured", c_void_p),
        ("asked", c_void_p),
        ("taken", c_long),
    )


class LawStruct(Structure):
    """`law_in_c`."""

    _fields_ = (
        ("law", c_void_p),
        ("tuner", c_void_p),
        ("memory", c_void_p),
        ("tuner_memory", c_void_p),
        ("scratch", c_void_p),
        ("previews", c_void_p),
        ("wanted", c_void_p),
        ("weights", c_void_p),
        ("kept", c_void_p),
        ("rows", c_long),
        ("columns", c_long),
    )


Controller: Final = ctypes.CFUNCTYPE(c_int, c_void_p, c_long, _Numbers, _Numbers)
"""(about, sample, measurement (12), torque (6)) -> 0, or anything else to give up."""
