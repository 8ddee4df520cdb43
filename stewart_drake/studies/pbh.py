"""The Popov-Belevitch-Hautus test by smallest singular values.

(A, B) is controllable if and only if [lambda I - A, B] has full row rank for every eigenvalue
lambda of A; stabilisable, if for every one on or outside the stability boundary. The smallest
singular value measures the distance from failure. The controllability matrix does not: the powers
of A in it lose all digits beyond a few states. (A, C) is observable or detectable if (A', C') is
controllable or stabilisable.

A left null vector w of the pencil, w' A = lambda w', w' B = 0, is a combination of states that the
input does not change. Its transposed counterpart is a motion that no output shows.
"""

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from stewart_drake.law.riccati import pbh_margins, pencils
from stewart_drake.types import Array, ArrayLike, Complex

TOLERANCE: Final = 1e-10
"""Singular values below this share of ||[A, B]|| count as zero: rounding leaves some 1e-14."""
BOUNDARY: Final = 1e-6
"""Distance from the stability boundary, relative to the spectral radius (1 in discrete time), up to
which a mode counts as not decaying."""
CLUSTER: Final = 1e-3
"""Distance over the spectral radius, up to which eigenvalues are one mode; see `cluster`."""
_SAME: Final = 1e-7
"""The same for eigenvalues at which the pencil fails: the failure locates them more exactly."""


@dataclass(frozen=True)
class Mode:
    """One eigenvalue and its test."""

    # point at which the pencil fails, else the mean of the cluster; a conjugate pair is represented
    # by the one with imaginary part > 0
    eigenvalue: complex
    multiplicity: int  # number of eigenvalues in the cluster (conjugates not counted)
    decays: bool  # whether it is inside the stability boundary
    margin: float  # smallest singular value of the pencil over ||[A, B]||
    # (n, d) orthonormal, spanning what the input does not reach or the output does not show; d = 0
    # for a mode that passes
    directions: Complex


@dataclass(frozen=True)
class Hautus:
    """The test of one pair."""

    tolerance: ClassVar[float] = TOLERANCE  # margin below which a mode fails
    modes: tuple[Mode, ...]  # every distinct eigenvalue, least margin first

    @property
    def complete(self) -> bool:
        """Whether the pair is controllable; for the dual, observable."""
        return not self.deficient

    @property
    def harmless(self) -> bool:
        """Whether the pair is stabilisable; for the dual, detectable."""
        return all(mode.decays for mode in self.deficient)

    @property
    def margin(self) -> float:
        """Least margin of all modes."""
        return min((mode.margin for mode in self.modes), default=np.inf)

    @property
    def lasting_margin(self) -> float:
        """Least margin of the modes that do not decay; infinite without any."""
        return min((mode.margin for mode in self.modes if not mode.decays), default=np.inf)

    @property
    def deficient(self) -> tuple[Mode, ...]:
        """Modes that fail."""
        return tuple(mode for mode in self.modes if mode.margin < self.tolerance)


def hautus(A: ArrayLike, B: ArrayLike, *, discrete: bool) -> Hautus:
    """Test (A, B) for controllability and stabilisability, mode by mode.

    It is that of x_{k+1} = A x_k + B u_k, or else of the differential equation. Observability and
    detectability of (A, C) are `hautus(A.T, C.T)`. Margins depend on units: scale states and inputs
    first, see `scaled`.
    """
    A, B = np.asarray(A, dtype=np.float64), np.asarray(B, dtype=np.float64)
    if A.ndim != 2 or A.shape[0] != A.shape[1] or A.size == 0:
        raise ValueError(f"A: got shape {A.shape}; expected a square matrix")
    if B.ndim != 2 or B.shape[0] != A.shape[0]:
        raise ValueError(f"B: got shape {B.shape}; expected ({A.shape[0]}, m)")
    if not (np.all(np.isfinite(A)) and np.all(np.isfinite(B))):
        raise ValueError("A, B: have entries that are not finite")
    eigenvalues = np.linalg.eigvals(A).astype(np.complex128)
    radius = float(np.abs(eigenvalues).max()) or 1.0
    size = float(np.linalg.norm(np.hstack([A, B]), 2)) or 1.0
    modes: list[Mode] = []
    for members in cluster(eigenvalues, CLUSTER * radius):
        center = complex(members.mean())
        if abs(center.imag) < CLUSTER * radius:
            center = complex(center.real)
        if center.imag < 0:
            continue  # its conjugate represents both
        # The pencil has full rank except at eigenvalues, so an additional point cannot fail.
        points = np.unique(np.append(members, center))
        margins = pbh_margins(A, B, points) / size
        failing = margins < TOLERANCE
        if not failing.any():
            found = [(center, float(margins.min()))]
        elif failing[points == center].any():  # a defective eigenvalue, see `cluster`
            found = [(center, float(margins[points == center][0]))]
        else:
            groups = cluster(points[failing], _SAME * radius)
            least = [group[pbh_margins(A, B, group).argmin()] for group in groups]
            found = [(complex(at), float(margins[points == at][0])) for at in least]
        for value, margin in found:
            decays = abs(value) < 1 - BOUNDARY if discrete else value.real < -BOUNDARY * radius
            directions = np.empty((len(A), 0), dtype=np.complex128)
            if margin < TOLERANCE:
                directions = _null_space(A, B, value, TOLERANCE * size)
            modes.append(Mode(value, len(members), bool(decays), margin, directions))
    return Hautus(tuple(sorted(modes, key=lambda mode: mode.margin)))


def scaled(
    A: Array, B: Array, C: Array, states: Array, inputs: Array, outputs: Array
) -> tuple[Array, Array, Array]:
    """Return the system in units in which 1 is a usual size of each state, input and output.

    With x = S x', u = U u', y = Y y' it is S^-1 A S, S^-1 B U and Y^-1 C S.
    """
    return (
        A * states / states[:, None],
        B * inputs / states[:, None],
        C * states / outputs[:, None],
    )


def cluster(values: Complex, distance: float) -> list[Complex]:
    """Return groups of values, each within `distance` of another value of its group.

    A defective eigenvalue of multiplicity p comes out spread over a circle of radius eps^(1/p),
    but the mean of the circle is exact to eps. The pencil is therefore evaluated at the mean.
    """
    remaining, groups = list(np.argsort(values.real, kind="stable")), []
    while remaining:
        group = [remaining.pop(0)]
        for member in group:  # grows while it is walked through
            near = [k for k in remaining if abs(values[k] - values[member]) <= distance]
            group += near
            remaining = [k for k in remaining if k not in near]
        groups.append(values[group])
    return groups


def _null_space(A: Array, B: Array, point: complex, threshold: float) -> Complex:
    """Return orthonormal w (n, d) with w' [point I - A, B] = 0, without conjugation."""
    left, values, _ = np.linalg.svd(pencils(A, B, np.array([point]))[0], full_matrices=False)
    return left[:, values < threshold].conj()
