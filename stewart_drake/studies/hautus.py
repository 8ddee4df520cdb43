"""The Hautus test (theory.md, section 21) on every model that a controller is designed with.

Three families: the paper's error model (20)-(28), continuous; the same sampled and with the torques
in flight, for every delay, as the minimal chain and as the paper's (37)-(39), which carries one
torque more; and the true plant, linearised at rest. All are scaled so that the motion, and the
torques it takes, have size 1, see `assess`.

The smallest singular value measures the distance from failure. The controllability matrix does not:
the powers of A in it lose all digits beyond a few states.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.primitives import (
    IsControllable,
    IsDetectable,
    IsObservable,
    IsStabilizable,
    LinearSystem,
)
from scipy.cluster.hierarchy import fclusterdata
from threadpoolctl import threadpool_limits

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import SINGULARITY_LIMIT, Failure, diagnose, measures_at
from stewart_drake.law.delay_model import (
    LinearModel,
    chain,
    delayed_model,
    double_integrators,
    linear_model,
    with_integral,
)
from stewart_drake.law.riccati import pbh_margins, pencils
from stewart_drake.mechanism.assembly import torque_map
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.signals import COORDINATE_NAMES, NUM_TORQUES
from stewart_drake.studies.verdict import Assessment, assess
from stewart_drake.types import Array, ArrayLike, Complex

# ---------------------------------------------------------------- the test

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
    # point at which the pencil fails, else the mean of the cluster; a conjugate pair is represented
    # by the one with imaginary part > 0
    eigenvalue: complex
    multiplicity: int  # number of eigenvalues in the cluster (conjugates not counted)
    decays: bool  # whether it is inside the stability boundary
    margin: float  # smallest singular value of the pencil over ||[A, B]||
    # (n, d) orthonormal, spanning what the input does not reach or the output does not show; d = 0
    # for a mode that passes
    directions: Complex

    @property
    def name(self) -> str:
        imaginary = f" ± {self.eigenvalue.imag:.3g}j" if self.eigenvalue.imag else ""
        return f"{self.eigenvalue.real:.3g}{imaginary}"


@dataclass(frozen=True)
class Hautus:
    modes: tuple[Mode, ...]  # every distinct eigenvalue, least margin first

    @property
    def margin(self) -> float:
        """Least margin of all modes; below TOLERANCE the pair is not controllable."""
        return min((mode.margin for mode in self.modes), default=np.inf)

    @property
    def lasting_margin(self) -> float:
        """The same of the modes that do not decay, for stabilisability; infinite without any."""
        return min((mode.margin for mode in self.modes if not mode.decays), default=np.inf)

    @property
    def deficient(self) -> tuple[Mode, ...]:
        return tuple(mode for mode in self.modes if mode.margin < TOLERANCE)


def hautus(A: ArrayLike, B: ArrayLike, *, discrete: bool) -> Hautus:
    """Test (A, B) for controllability and stabilisability, mode by mode.

    It is that of x_{k+1} = A x_k + B u_k, or else of the differential equation. Observability and
    detectability of (A, C) are `hautus(A.T, C.T)`. Margins depend on units: scale states and inputs
    first, see `scaled`.
    """
    A, B = np.asarray(A, dtype=np.float64), np.asarray(B, dtype=np.float64)
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
            if margin < TOLERANCE:  # w with w' [value I - A, B] = 0, without conjugation
                pencil = pencils(A, B, np.array([value]))[0]
                left, singular_values, _ = np.linalg.svd(pencil, full_matrices=False)
                directions = left[:, singular_values < TOLERANCE * size].conj()
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
    if len(values) < 2:
        return [values]
    points = np.column_stack([values.real, values.imag])
    groups = fclusterdata(points, distance, "distance", method="single")
    return [values[groups == group] for group in np.unique(groups)]


# ---------------------------------------------------------------- the models

_SHOWN: Final = 0.01
"""Share of a direction from which a state is named."""
LONGEST: Final = 30
"""Whole periods of delay up to which the delayed models are tested."""
POSES: Final = 9
"""Instants at which the plant is linearised along the reference."""
QUESTIONS: Final = ("controllable", "stabilizable", "observable", "detectable")


def describe(directions: NDArray[np.complex128]) -> str:
    """Return directions (n, d) in words: their number, and the states that they consist of.

    The n states are six by six the pose error, rate error and integral, then torques in flight.
    """
    d = directions.shape[1]
    share = (np.abs(directions) ** 2).sum(axis=1) / d
    large = share.reshape(-1, NUM_TORQUES) >= _SHOWN / NUM_TORQUES
    named = list[str]()
    for group, part in zip(("pose error", "rate error", "integral"), large, strict=False):
        if part.any():
            names = ", ".join(np.array(COORDINATE_NAMES)[part])
            named.append(group if part.all() else f"{group} ({names})")
    torques = [f"T(k-{len(large) - row})" for row in np.flatnonzero(large[3:].any(axis=1)) + 3]
    if len(torques) == 1:
        named.append(f"torque {torques[0]}")
    elif torques:
        named.append(f"torques {torques[0]} to {torques[-1]}")
    return f"{d} direction{'s' if d > 1 else ''} in {' and '.join(named)}"


@dataclass(frozen=True)
class System:
    name: str  # unique
    family: str  # `error model`, `minimal chain`, `paper's chain`, `chain under gravity` or `plant`
    steps: int | None  # of delay, or None
    time: float | None  # s along the reference, None for home
    gravity: bool | None  # of a plant; None for the other families
    n: int  # states
    m: int  # inputs
    reach: Hautus  # test of (A, B)
    view: Hautus  # test of (A', C')
    radius: float  # spectral radius of A
    drake: dict[str, bool]  # Drake's answers to QUESTIONS
    words: tuple[str, ...]  # a sentence for each mode that fails

    @property
    def margins(self) -> dict[str, float]:
        """Least relative singular value behind each answer, infinite without a relevant mode."""
        reach, view = self.reach, self.view
        values = reach.margin, reach.lasting_margin, view.margin, view.lasting_margin
        return dict(zip(QUESTIONS, values, strict=True))

    @property
    def answers(self) -> dict[str, bool]:
        """Ours to QUESTIONS."""
        return {word: margin >= TOLERANCE for word, margin in self.margins.items()}

    @property
    def note(self) -> str:
        """Why Drake disagrees, or empty."""
        ours, drake, parts = self.answers, self.drake, []
        if missed := [word for word in QUESTIONS if ours[word] and not drake[word]]:
            decades = (self.n - 1) * abs(np.log10(max(self.radius, 1e-300)))
            parts.append(
                f"not {' and not '.join(missed)}, from the rank of powers up to the {self.n - 1}th "
                f"of a matrix with spectral radius {self.radius:.3g}, which span {decades:.0f} "
                "decades: rounding decides the rank"
            )
        if passed := [word for word in QUESTIONS if drake[word] and not ours[word]]:
            parts.append(f"{' and '.join(passed)}, taking anything above rounding for full rank")
        return f"Drake says {'; '.join(parts)}" if parts else ""

    @property
    def summary(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "family": self.family,
            "n": self.n,
            "m": self.m,
            "mu": self.steps,
            "t": self.time,
            **self.answers,
            **{f"{word}_margin": margin for word, margin in self.margins.items()},
            "deficient": list(self.words),
            "controllable_modes": _modes_summary(self.reach),
            "observable_modes": _modes_summary(self.view),
            "drake": self.drake,
            "note": self.note or None,
        }


@dataclass(frozen=True)
class HautusStudy:
    """All systems in the order of the families; skipped poses by name, with the reason."""

    assessment: Assessment
    systems: list[System]
    skipped: dict[str, str]

    def family(self, name: str) -> list[System]:
        return [system for system in self.systems if system.family == name]

    @property
    def summary(self) -> dict[str, Any]:
        return {
            "tolerance": TOLERANCE,
            "units": {"pose": self.assessment.motion, "torque": self.assessment.torque},
            "obstacles": self.assessment.obstacles,
            "systems": [system.summary for system in self.systems],
            "skipped": [{"name": n, "reason": reason} for n, reason in self.skipped.items()],
        }


def study_hautus(scenario: Scenario) -> HautusStudy:
    """Test every model of a scenario.

    A motion or a home pose outside the workspace is reported in `Assessment.obstacles`.
    """
    with threadpool_limits(limits=1):
        found = assess(scenario)
        study = HautusStudy(found, [], {})
        home = found.experiment.mechanism.home
        reason = _unusable(found.home_failure)
        if reason is None:
            tau = torque_map(found.experiment.mechanism, home)
            study.systems.extend(_error_models(found, double_integrators(tau)))
        else:
            study.skipped["error model and delay chains"] = reason
        reference, places = found.experiment.reference, [("home", None, home)]
        for t in np.linspace(0.0, scenario.duration, POSES):
            places.append((f"t = {t:.2f} s", float(t), reference.value(t)[:, 0]))
        for gravity in (False, True):
            for place, time, pose in places:
                name = f"plant {'under' if gravity else 'without'} gravity, {place}"
                model = _linearized(found, gravity, pose)
                if isinstance(model, str):
                    study.skipped[name] = model
                else:
                    study.systems.append(
                        _test(found, name, "plant", model, time=time, gravity=gravity)
                    )
        return study


def _error_models(found: Assessment, model: LinearModel) -> list[System]:
    """Test the continuous model, and delay chains of it and of the plant under gravity."""
    delay, period = found.experiment.scenario.delay, found.experiment.scenario.controller.period
    systems = [_test(found, "error model, continuous", "error model", with_integral(model))]
    heavy = _linearized(found, True, found.experiment.mechanism.home)
    families: list[tuple[str, LinearModel | str, bool]] = [
        ("minimal chain", model, False),
        ("paper's chain", model, True),
        ("chain under gravity", heavy, False),
    ]
    for family, continuous, extra in families:
        if isinstance(continuous, str):
            continue  # the plant's own entry has the reason
        for steps in range(LONGEST + 1):
            sampled = delayed_model(continuous, period, steps, delay.fraction, integral=True)
            discrete = chain(sampled, steps + 1 if extra else 0)
            systems.append(
                _test(found, f"{family}, mu = {steps}", family, discrete, steps, period=period)
            )
    return systems


def _linearized(found: Assessment, gravity: bool, pose: Array) -> LinearModel | str:
    """Return the plant held still at a pose (6,), or why it cannot be."""
    mechanism = found.experiment.mechanism
    reason = _unusable(diagnose(mechanism, 0.0, pose))
    if reason is not None:
        return reason
    dynamics = StewartDynamics(mechanism, gravity=gravity)
    if not gravity:
        return linear_model(*dynamics.linearize(pose, torque=np.zeros(NUM_TORQUES)))
    if abs(measures_at(mechanism, pose).parallel) < SINGULARITY_LIMIT:
        return "near a parallel singularity the torques that hold the plate have no bound"
    return linear_model(*dynamics.linearize(pose))


def _unusable(failure: Failure | None) -> str | None:
    """Return why nothing can be linearised; near a parallel singularity something can."""
    if failure is None or (failure.leg is None and "parallel" in failure.reason):
        return None
    return failure.reason


def _test(
    found: Assessment,
    name: str,
    family: str,
    model: LinearModel,
    steps: int | None = None,
    time: float | None = None,
    gravity: bool | None = None,
    period: float = 0.0,
) -> System:
    n, m = model.B.shape
    p = len(found.motion)
    states = np.concatenate([np.tile(found.motion, 3), np.full(max(0, n - 3 * p), found.torque)])
    inputs, outputs = np.full(m, found.torque), np.tile(found.motion, len(model.C) // p)
    A, B, C = scaled(*model, states[:n], inputs, outputs)
    reach, view = hautus(A, B, discrete=period > 0), hautus(A.T, C.T, discrete=period > 0)
    system = LinearSystem(A, B, C, np.zeros((len(C), m)), period)
    asked = (IsControllable, IsStabilizable, IsObservable, IsDetectable)
    drake = {word: bool(ask(system)) for word, ask in zip(QUESTIONS, asked, strict=True)}
    words = [
        f"no {part} {describe(mode.directions)}, mode {mode.name}"
        for part, test in (("torque reaches", reach), ("output shows", view))
        for mode in test.deficient
    ]
    radius = float(np.abs(np.linalg.eigvals(A)).max())
    return System(
        name=name,
        family=family,
        steps=steps,
        time=time,
        gravity=gravity,
        n=n,
        m=m,
        reach=reach,
        view=view,
        radius=radius,
        drake=drake,
        words=tuple(words),
    )


def _modes_summary(test: Hautus) -> list[dict[str, Any]]:
    return [
        {
            "eigenvalue": [mode.eigenvalue.real, mode.eigenvalue.imag],
            "multiplicity": mode.multiplicity,
            "decays": mode.decays,
            "margin": mode.margin,
            "deficient_directions": mode.directions.shape[1],
        }
        for mode in test.modes
    ]
