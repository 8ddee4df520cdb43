"""What is told of a Hautus analysis."""

from collections.abc import Iterable
from functools import partial
from typing import Final

from stewart_drake.law.hautus import Hautus
from stewart_drake.reporting.analysis_figures import chain_figure, plant_figure
from stewart_drake.reporting.document import Document, Paragraph, Picture, Section, Table, Tone
from stewart_drake.reporting.words import capital
from stewart_drake.studies.hautus import QUESTIONS, HautusStudy, System

_CHAINS: Final = ("minimal chain", "paper's chain", "chain under gravity")

_METHOD: Final = (
    "A mode λ can be controlled if the matrix [λ − A, B] has full row rank. The margin is its "
    "smallest singular value over the norm of [A, B]: the relative change of the model that would "
    "make the mode uncontrollable. Observability is the same test of the transposed matrices. "
    "States and torques are counted in the amplitudes of the motion and in the torque it takes.",
    "Stabilisable and detectable ask only for the modes that do not decay by themselves. That is "
    "what the Riccati equation needs.",
)
_CHAIN_TEXT: Final = (
    "Sampled, with the torques in flight as states. The paper's chain carries one torque more than "
    "there are in flight. Without a fraction of a period that torque acts on nothing and no output "
    "shows it: six modes at λ = 0 fail the test of observability, whatever μ. They are gone after "
    "one step, so that the pair stays detectable. The minimal chain has no such modes.",
    "The chain under gravity is the true plant, linearised at home. Its margin falls with e^(−pη): "
    "the fastest mode p has grown by that much when a torque arrives.",
)
_MARGINS: Final = (
    "Margins over the delay. Points at 1e-17 are rounding: there the paper's chain is not "
    "observable. Each mark is one model."
)


def document(study: HautusStudy) -> Document:
    """The models that matter, what fails, and folded, every model and mode."""
    verdict, tone = _verdict(study)
    sc, found = study.basis.experiment.scenario, study.basis
    sections = []
    chains = [system for name in _CHAINS for system in study.family(name)]
    if chains:
        shown = [
            one for name in _CHAINS for one in _landmarks(study.family(name), sc.true_delay.steps)
        ]
        table = _models_table(shown, "Some delays, of mu periods.")
        picture = Picture(partial(chain_figure, study), _MARGINS)
        failing = _deficiencies(chains)
        sections.append(Section("Delay chains", *_CHAIN_TEXT, table, *failing, picture))
    plants = [*study.family("error model"), *study.family("plant")]
    if plants:
        shown = [*study.family("error model"), *_typical_plants(study)]
        text = "The plant is held still at poses along the reference; the outputs are the pose."
        table = _models_table(shown, "At home, and where the margin is least.")
        figure = partial(plant_figure, study)
        picture = Picture(figure, "Margins of the plant along the reference.")
        heading = "The plant and the paper's error model"
        sections.append(Section(heading, text, table, *_deficiencies(plants), picture))
    if study.skipped:
        rows = _skipped(study)
        sections.append(Section("Left out", Table(("reason", "models"), rows, brief=True)))
    noted = [(s.name, f"{s.reach.margin:.1e}", f"{s.view.margin:.1e}", s.note)
             for s in study.systems if s.note]  # fmt: skip
    sections.append(Section("Drake's answers", Paragraph(_drake_text(study), brief=True)))
    if noted:
        head = ("model", "controllability margin", "observability margin", "note")
        caption = "Where Drake's rank of matrix powers disagrees with the margins."
        table = Table(head, noted, caption)
        sections.append(Section("Where Drake disagrees", table, folded=True))
    sections.append(Section("How it is tested", *_METHOD, folded=True))
    sections.append(Section("Every mode", _modes_table(study.systems), folded=True))
    sections.append(Section("Every model", _systems_table(study.systems), folded=True))
    motion = ", ".join(f"{value:.3g}" for value in found.motion)
    facts = {
        "mechanism": found.experiment.mechanism.name,
        "period, delay": f"{sc.controller.period:g} s, μ = {sc.true_delay.steps}, "
        f"fraction {sc.true_delay.fraction:g}",
        "units of the states": f"[{motion}] rad and m, these per s, these times s",
        "unit of the torques": f"{found.torque:.3g} N m",
    }
    return Document("Controllability and observability", verdict, sections, tone, facts)


def _verdict(study: HautusStudy) -> tuple[str, Tone]:
    """The answer in a sentence or two, and how good it is."""
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
    """Without and under gravity, the plant at home, which comes first, and where it is worst."""
    shown = []
    for where in ("without", "under"):
        some = [s for s in study.family("plant") if s.name.startswith(f"plant {where} gravity")]
        if some:
            worst = min(some, key=lambda system: system.margins["controllable"])
            shown += [some[0]] if some[0] is worst else [some[0], worst]
    return shown


def _landmarks(chains: list[System], own: int) -> list[System]:
    """Those without delay, at this one and at the longest."""
    longest = max((system.steps or 0 for system in chains), default=0)
    return [system for system in chains if system.steps in (0, own, longest)]


def _deficiencies(systems: Iterable[System]) -> list[Paragraph]:
    """What fails, a sentence for each family and test, with the last model as the example."""
    families: dict[str, list[System]] = {}
    for system in systems:
        families.setdefault(system.family, []).append(system)
    found = []
    for family, some in families.items():
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


def _skipped(study: HautusStudy) -> list[tuple[str, str]]:
    """What was left out, by reason."""
    reasons: dict[str, list[str]] = {}
    for name, reason in study.skipped:
        reasons.setdefault(reason, []).append(name)
    return [(reason, "; ".join(names)) for reason, names in reasons.items()]


def _drake_text(study: HautusStudy) -> str:
    different = [system for system in study.systems if system.note]
    if not different:
        return "Drake's own tests agree on every model."
    return (
        f"Drake's own tests disagree on {len(different)} of {len(study.systems)} models, such as "
        f"{different[-1].name}: {different[-1].note}."
    )


def _models_table(systems: Iterable[System], caption: str) -> Table:
    """The two questions about all modes; where the answer is no, what holds of those that stay."""
    rows = []
    for one in systems:
        cells = [one.name, str(one.n)]
        for word, lasting in (("controllable", "stabilizable"), ("observable", "detectable")):
            answer = lasting if one.answers[lasting] else "no"
            answer = "yes" if one.answers[word] else answer
            cells += [answer, f"{one.margins[word]:.1e}"]
        rows.append(cells)
    columns = ("model", "n", "controllable", "margin", "observable", "margin")
    return Table(columns, rows, caption, brief=True)


def _systems_table(systems: Iterable[System]) -> Table:
    rows = [
        (
            system.name,
            str(system.n),
            *(f"{_yes(system.answers[word])}, {system.margins[word]:.1e}" for word in QUESTIONS),
        )
        for system in systems
    ]
    return Table(("model", "n", *(f"{word}, margin" for word in QUESTIONS)), rows)


def _modes_table(systems: Iterable[System]) -> Table:
    rows = [
        (system.name, test, *row)
        for system in systems
        for test, outcome in (("input", system.reach), ("output", system.view))
        for row in _mode_rows(outcome)
    ]
    columns = ("model", "test", "eigenvalue", "multiplicity", "decays", "margin", "deficient")
    return Table(columns, rows, "Eigenvalues in 1/s (plant, error model) or per period (chains).")


def _mode_rows(test: Hautus) -> list[tuple[str, ...]]:
    return [
        (
            f"{mode.eigenvalue.real:.4g}"
            + (f" ± {mode.eigenvalue.imag:.4g}j" if mode.eigenvalue.imag else ""),
            str(mode.multiplicity),
            _yes(mode.decays),
            f"{mode.margin:.1e}",
            str(mode.directions.shape[1]),
        )
        for mode in test.modes
    ]


def _yes(answer: bool) -> str:
    return "yes" if answer else "no"
