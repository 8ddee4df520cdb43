"""Directions in state space in words: which pose errors, rates, integrals, torques in flight."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.law.hautus import Mode
from stewart_drake.scenario.signals import COORDINATE_NAMES, NUM_TORQUES

_TORQUE: Final = "torque "
_SHOWN: Final = 0.01
"""Share of a direction from which a state is named."""


class Label(NamedTuple):
    """A state's group, `pose error`, `torque T(k-8)`, and its name within, `roll`, `motor 1`."""

    group: str
    name: str


def state_labels(n: int) -> list[Label]:
    """Of 12 states of the plant, 18 of the error model, or those and torques in flight."""
    groups = ("pose error", "rate error", "integral")[: min(n // len(COORDINATE_NAMES), 3)]
    labels = [Label(group, name) for group in groups for name in COORDINATE_NAMES]
    length = (n - len(labels)) // NUM_TORQUES
    for place in range(length):
        group = f"{_TORQUE}T(k-{length - place})"
        labels += [Label(group, f"motor {motor + 1}") for motor in range(NUM_TORQUES)]
    return labels


def describe(directions: NDArray[np.complex128], labels: list[Label]) -> str:
    """Directions (n, d) in words: their number, and the states that they consist of."""
    d = directions.shape[1]
    share = (np.abs(directions) ** 2).sum(axis=1) / d
    groups: dict[str, list[str]] = {}
    for label, part in zip(labels, share, strict=True):
        if part >= _SHOWN / NUM_TORQUES:
            groups.setdefault(label.group, []).append(label.name)
    sizes = {g: sum(label.group == g for label in labels) for g in groups}
    named = [
        group if len(names) == sizes[group] else f"{group} ({', '.join(names)})"
        for group, names in groups.items()
        if not group.startswith(_TORQUE)
    ]
    torques = [group for group in groups if group.startswith(_TORQUE)]
    if torques:
        last = torques[-1].removeprefix(_TORQUE)
        named.append(
            torques[0]
            if len(torques) == 1
            else f"torques {torques[0].removeprefix(_TORQUE)} to {last}"
        )
    return f"{d} direction{'s' if d > 1 else ''} in {' and '.join(named)}"


def mode_words(mode: Mode, labels: list[Label]) -> str:
    """What of a mode fails, and its eigenvalue: `1 direction in pose error (x), mode 0`."""
    value = f"{mode.eigenvalue.real:.3g}"
    if mode.eigenvalue.imag:
        value += f" ± {mode.eigenvalue.imag:.3g}j"
    return f"{describe(mode.directions, labels)}, mode {value}"
