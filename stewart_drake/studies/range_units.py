"""What the numbers of `analyze robustness --vary` are shares of; nothing heavy is imported here."""

from typing import Final

RANGE_UNITS: Final = {
    "payload": "+-share of the plate's mass",
    "torque_bias": "share of the reference's largest torque",
    "noise": "share of half the reference's peak to peak",
    "torque_limit": "[least, most] in peak torques of the undisturbed run",
    "damping": "share of the reference's largest torque, at its largest crank speed",
    "delay": "+-periods of the controller",
    "delay_steps": "+-whole periods",
    "lengths": "share of the mean crank length",
    "anchors": "share of the mean crank length",
}
"""By name of a field of `studies.uncertainty.Ranges`, where each is defined in full."""
