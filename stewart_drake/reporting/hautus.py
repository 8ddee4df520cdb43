"""Document and figures of a Hautus analysis."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import groupby
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from stewart_drake.reporting.document import Document, Paragraph, capital, from_template
from stewart_drake.reporting.panels import Curve, Panel, draw
from stewart_drake.reporting.style import Line, line
from stewart_drake.studies.hautus import TOLERANCE, HautusStudy, System

_CHAINS: Final = ("minimal chain", "paper's chain", "chain under gravity")
_SMALLEST: Final = 1e-18
"""Margin at which smaller ones, which are rounding errors, are drawn."""


def document(study: HautusStudy) -> Document:
    sc = study.assessment.experiment.scenario
    chains = [system for name in _CHAINS for system in study.family(name)]
    shown = [s for name in _CHAINS for s in _landmarks(study.family(name), sc.true_delay.steps)]
    error_model = study.family("error model")
    plants = [*error_model, *study.family("plant")]
    useless = [
        s.name for s in study.systems if not (s.answers["stabilizable"] and s.answers["detectable"])
    ]
    # At home the plant without gravity is the error model.
    chain = "chain under gravity" if sc.plant.gravity else "minimal chain"
    own = (s for s in study.family(chain) if s.steps == sc.true_delay.steps)
    skipped: dict[str, list[str]] = {}
    for name, reason in study.skipped.items():
        skipped.setdefault(reason, []).append(name)
    return from_template(
        "hautus",
        "bad" if useless or not study.systems or study.assessment.obstacles else "good",
        study=study,
        sc=sc,
        useless=useless,
        own=next(own, None),
        tolerance=TOLERANCE,
        least=min(study.systems, key=lambda s: s.margins["stabilizable"], default=None),
        chains=chains and shown,
        chains_fail=_deficiencies(chains),
        chain_figure=chains and partial(chain_figure, study),
        plants=plants and [*error_model, *_typical_plants(study)],
        plants_fail=_deficiencies(plants),
        plant_figure=plants and partial(plant_figure, study),
        skipped=skipped.items(),
        noted=[system for system in study.systems if system.note],
        modes=[
            (system.name, test, mode)
            for system in study.systems
            for test, outcome in (("input", system.reach), ("output", system.view))
            for mode in outcome.modes
        ],
    )


def _typical_plants(study: HautusStudy) -> list[System]:
    """Return the plant at home and the worst plant, without and under gravity."""
    shown: dict[int, System] = {}
    for gravity in (False, True):
        some = [s for s in study.family("plant") if s.gravity is gravity]
        for one in some[:1] + sorted(some, key=lambda s: s.margins["controllable"])[:1]:
            shown[id(one)] = one
    return list(shown.values())


def _landmarks(chains: list[System], own: int) -> list[System]:
    """Return the chains without delay, at this delay and at the longest."""
    longest = max((system.steps or 0 for system in chains), default=0)
    return [system for system in chains if system.steps in (0, own, longest)]


def _deficiencies(systems: Sequence[System]) -> list[Paragraph]:
    """Return a sentence for each family and failed test, with the last model as example."""
    found = []
    for family, group in groupby(systems, key=lambda system: system.family):
        some = list(group)
        for test, opening, property_ in (
            ("reach", "no torque", "controllable"),
            ("view", "no output", "observable"),
        ):
            failing = [system for system in some if getattr(system, test).deficient]
            if failing:
                words = [word for word in failing[-1].words if word.startswith(opening)]
                text = (
                    f"{capital(family)}: {len(failing)} of {len(some)} models are not "
                    f"{property_}, such as {failing[-1].name}: {'; '.join(words)}."
                )
                found.append(Paragraph(text, brief=True))
    return found


def chain_figure(study: HautusStudy) -> Figure:
    lines = {name: (study.family(name), line(k)) for k, name in enumerate(_CHAINS)}
    over = "delay μ  [periods]"
    return _margin_figure(lines, over, lambda one: float(one.steps or 0), _envelope(study))


def plant_figure(study: HautusStudy) -> Figure:
    moved = [system for system in study.family("plant") if system.time is not None]
    lines = {
        where: ([system for system in moved if system.gravity is gravity], look)
        for where, gravity, look in (
            ("without gravity", False, line(0)),
            ("under gravity", True, line(2)),
        )
    }
    return _margin_figure(lines, "time on the reference  [s]", lambda one: one.time or 0.0)


def _margin_figure(
    lines: Mapping[str, tuple[Sequence[System], Line]],
    over: str,
    place: Callable[[System], float],
    more: Sequence[Curve] = (),
) -> Figure:
    """Draw margins of controllability, with more curves, and of observability over a place."""
    panels = []
    for word, title in {"controllable": "controllability", "observable": "observability"}.items():
        curves = []
        for label, (systems, look) in lines.items():
            x = [place(one) for one in systems]
            margins = np.maximum([one.margins[word] for one in systems], _SMALLEST)
            curves.append(Curve(x, margins, label, look))
        curves += more if word == "controllable" else ()
        panels.append(
            Panel(
                f"margin of {title}",
                curves,
                over,
                limits={TOLERANCE: f"tolerance {TOLERANCE:g}"},
                yscale="powers",
                height=2.5,
            )
        )
    return draw(panels, 2)


def _envelope(study: HautusStudy) -> list[Curve]:
    """Return the margin without delay times e^(-p eta), with p the fastest mode."""
    chains = study.family("chain under gravity")
    plants = [s for s in study.family("plant") if s.gravity and s.time is None]
    if not chains or not plants:
        return []
    pole = max(mode.eigenvalue.real for mode in plants[0].reach.modes)
    period = study.assessment.experiment.scenario.controller.period
    steps = np.array([system.steps for system in chains], dtype=float)
    values = chains[0].margins["controllable"] * np.exp(-pole * period * steps)
    return [Curve(steps, values, "$e^{-pη}$, home under gravity", Line("#888888", "-", 0.9))]
