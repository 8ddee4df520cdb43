"""Document and figures of a Hautus analysis."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from itertools import groupby
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from stewart_drake.law.hautus import Mode
from stewart_drake.reporting.document import Document, Paragraph, Table, Tone, table
from stewart_drake.reporting.outline import sections
from stewart_drake.reporting.panels import Curve, Panel, draw
from stewart_drake.reporting.style import Line, line
from stewart_drake.reporting.words import capital
from stewart_drake.studies.hautus import QUESTIONS, HautusStudy, System

_CHAINS: Final = ("minimal chain", "paper's chain", "chain under gravity")
_SMALLEST: Final = 1e-18
"""Smaller margins are rounding, and are drawn here."""


def document(study: HautusStudy) -> Document:
    """Return the models that matter, what fails, and folded, every model and mode."""
    verdict, tone = _verdict(study)
    sc, found = study.basis.experiment.scenario, study.basis
    chains = [system for name in _CHAINS for system in study.family(name)]
    shown = [s for name in _CHAINS for s in _landmarks(study.family(name), sc.true_delay.steps)]
    error_model = study.family("error model")
    plants = [*error_model, *study.family("plant")]
    noted = [system for system in study.systems if system.note]
    modes = [
        (system.name, test, mode)
        for system in study.systems
        for test, outcome in (("input", system.reach), ("output", system.view))
        for mode in outcome.modes
    ]
    context = {
        "chains": chains and _models_table(shown),
        "chains_fail": _deficiencies(chains),
        "chain_figure": chains and partial(chain_figure, study),
        "plants": plants and _models_table([*error_model, *_typical_plants(study)]),
        "plants_fail": _deficiencies(plants),
        "plant_figure": plants and partial(plant_figure, study),
        "skipped": study.skipped and _skipped(study),
        "noted": noted,
        "notes": noted and _notes(noted),
        "modes": _modes_table(modes),
        "systems": _systems_table(study.systems),
    }
    facts = {
        "mechanism": found.experiment.mechanism.name,
        "period, delay": f"{sc.controller.period:g} s, μ = {sc.true_delay.steps}, "
        f"fraction {sc.true_delay.fraction:g}",
        "units of the states": f"[{', '.join(f'{value:.3g}' for value in found.motion)}] "
        "rad and m, these per s, these times s",
        "unit of the torques": f"{found.torque:.3g} N m",
    }
    parts = sections("hautus", study=study, **context)
    return Document("Controllability and observability", verdict, parts, tone, facts)


def _verdict(study: HautusStudy) -> tuple[str, Tone]:
    obstacles = " ".join(study.basis.obstacles)
    bad = [
        s.name for s in study.systems if not (s.answers["stabilizable"] and s.answers["detectable"])
    ]
    if bad:
        more = f" and {len(bad) - 1} more" if len(bad) > 1 else ""
        return f"{obstacles} No controller can be designed for: {bad[0]}{more}.".strip(), "bad"
    if not study.systems:
        return f"{obstacles} There is no pose at which a model exists.".strip(), "bad"
    least = min(study.systems, key=lambda s: s.margins["stabilizable"])
    text = (
        f"All {len(study.systems)} models are stabilisable and detectable; the least margin is "
        f"{least.margins['stabilizable']:.1e} ({least.name}), the tolerance "
        f"{least.reach.tolerance:.0e}."
    )
    return f"{obstacles} {text}".strip(), "bad" if obstacles else "good"


def _typical_plants(study: HautusStudy) -> list[System]:
    """Return without and under gravity the plant at home, which comes first, and the worst."""
    shown: dict[int, System] = {}
    for where in ("without", "under"):
        some = [s for s in study.family("plant") if s.name.startswith(f"plant {where} gravity")]
        for one in some[:1] + sorted(some, key=lambda s: s.margins["controllable"])[:1]:
            shown[id(one)] = one
    return list(shown.values())


def _landmarks(chains: list[System], own: int) -> list[System]:
    """Return the chains without delay, at this delay and at the longest."""
    longest = max((system.steps or 0 for system in chains), default=0)
    return [system for system in chains if system.steps in (0, own, longest)]


def _deficiencies(systems: Sequence[System]) -> list[Paragraph]:
    """Return a sentence for each family and test that fails, with the last model as example."""
    found = []
    for family, group in groupby(systems, key=lambda system: system.family):
        some = list(group)
        for test, opening in (("reach", "no torque"), ("view", "no output")):
            failing = [system for system in some if getattr(system, test).deficient]
            if failing:
                words = [word for word in failing[-1].words if word.startswith(opening)]
                text = (
                    f"{capital(family)}: {len(failing)} of {len(some)} models fail "
                    f"here, such as {failing[-1].name}: {'; '.join(words)}."
                )
                found.append(Paragraph(text, brief=True))
    return found


def _skipped(study: HautusStudy) -> Table:
    reasons: dict[str, list[str]] = {}
    for name, reason in study.skipped:
        reasons.setdefault(reason, []).append(name)
    columns = {"reason": lambda one: one[0], "models": lambda one: "; ".join(one[1])}
    return table(reasons.items(), columns, brief=True)


def _notes(noted: Iterable[System]) -> Table:
    return table(
        noted,
        {
            "model": lambda one: one.name,
            "controllability margin": lambda one: f"{one.reach.margin:.1e}",
            "observability margin": lambda one: f"{one.view.margin:.1e}",
            "note": lambda one: one.note,
        },
    )


def _models_table(systems: Iterable[System]) -> Table:
    """Return the two questions about all modes, or what holds of those that do not decay."""

    def answer(one: System, word: str, lasting: str) -> str:
        if one.answers[word]:
            return "yes"
        return lasting if one.answers[lasting] else "no"

    return table(
        systems,
        {
            "model": lambda one: one.name,
            "n": lambda one: one.n,
            "controllable": lambda one: answer(one, "controllable", "stabilizable"),
            "margin": lambda one: f"{one.margins['controllable']:.1e}",
            "observable": lambda one: answer(one, "observable", "detectable"),
            "margin ": lambda one: f"{one.margins['observable']:.1e}",
        },
        brief=True,
    )


def _systems_table(systems: Iterable[System]) -> Table:
    def cell(word: str, one: System) -> str:
        return f"{_yes(one.answers[word])}, {one.margins[word]:.1e}"

    answers = {f"{word}, margin": partial(cell, word) for word in QUESTIONS}
    return table(systems, {"model": lambda one: one.name, "n": lambda one: one.n, **answers})


def _modes_table(modes: Iterable[tuple[str, str, Mode]]) -> Table:
    def value(mode: Mode) -> str:
        imaginary = f" ± {mode.eigenvalue.imag:.4g}j" if mode.eigenvalue.imag else ""
        return f"{mode.eigenvalue.real:.4g}{imaginary}"

    return table(
        modes,
        {
            "model": lambda one: one[0],
            "test": lambda one: one[1],
            "eigenvalue": lambda one: value(one[2]),
            "multiplicity": lambda one: one[2].multiplicity,
            "decays": lambda one: _yes(one[2].decays),
            "margin": lambda one: f"{one[2].margin:.1e}",
            "deficient": lambda one: one[2].directions.shape[1],
        },
    )


def _yes(answer: bool) -> str:
    return "yes" if answer else "no"


def chain_figure(study: HautusStudy) -> Figure:
    """Draw margins of the delay chains over the delay, against the tolerance."""
    lines = {
        name: ([s.steps or 0 for s in study.family(name)], study.family(name), line(k))
        for k, name in enumerate(_CHAINS)
    }
    return draw(_margins(study, lines, "delay μ  [periods]", _envelope(study)), 2)


def plant_figure(study: HautusStudy) -> Figure:
    """Draw margins of the plant held still along the reference."""
    lines = {}
    for where, look in (("without", line(0)), ("under", line(2))):
        some = [
            s
            for s in study.family("plant")
            if f"plant {where} gravity" in s.name and s.time is not None
        ]
        lines[f"{where} gravity"] = ([s.time or 0.0 for s in some], some, look)
    return draw(_margins(study, lines, "time on the reference  [s]"), 2)


def _margins(
    study: HautusStudy,
    lines: Mapping[str, tuple[Sequence[float], Sequence[System], Line]],
    over: str,
    more: Sequence[Curve] = (),
) -> list[Panel]:
    """Return margins of controllability and observability, against the tolerance."""
    tolerance, panels = study.systems[0].reach.tolerance, []
    for word, title in {"controllable": "controllability", "observable": "observability"}.items():
        curves = [
            Curve(x, np.maximum([one.margins[word] for one in systems], _SMALLEST), label, look)
            for label, (x, systems, look) in lines.items()
        ]
        panels.append(
            Panel(
                f"margin of {title}",
                [*curves, *(more if word == "controllable" else ())],
                over,
                limits={tolerance: f"tolerance {tolerance:g}"},
                yscale="powers",
                height=2.5,
            )
        )
    return panels


def _envelope(study: HautusStudy) -> list[Curve]:
    """Return the margin without delay times e^(-p eta), with p the fastest mode."""
    chains = study.family("chain under gravity")
    plants = [s for s in study.family("plant") if s.name == "plant under gravity, home"]
    if not chains or not plants:
        return []
    pole = max(mode.eigenvalue.real for mode in plants[0].reach.modes)
    period = study.basis.experiment.scenario.controller.period
    steps = np.array([system.steps for system in chains], dtype=float)
    values = chains[0].margins["controllable"] * np.exp(-pole * period * steps)
    return [Curve(steps, values, "$e^{-pη}$, home under gravity", Line("#888888", "-", 0.9))]
