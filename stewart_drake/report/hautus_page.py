"""The Hautus analysis for a terminal and as a page."""

from collections.abc import Iterable
from typing import Final

from stewart_drake.law.hautus import Hautus
from stewart_drake.report.analysis_figures import chain_figure, plant_figure
from stewart_drake.report.page import Page, Picture, Provenance, Section, Table, Tone
from stewart_drake.report.tables import wrap
from stewart_drake.studies.hautus import QUESTIONS, HautusStudy, System

_CHAINS: Final = ("minimal chain", "paper's chain", "chain under gravity")
_ROW: Final = "{:<38}{:>5}{:>8}{:>10}{:>8}{:>10}"

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


def verdict(study: HautusStudy) -> tuple[str, Tone]:
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


def hautus_table(study: HautusStudy) -> str:
    """The models that matter, and what the rest does, in 80 columns."""
    lines = [wrap(verdict(study)[0]), ""]
    head = ("model", "n", "ctrl", "margin", "obs", "margin")
    lines.append(_ROW.format(*head))
    for system in _chosen(study):
        values = system.margins
        answers = {word: _yes(system.answers[word]) for word in QUESTIONS}
        if not system.answers["observable"] and system.answers["detectable"]:
            answers["observable"] = "det."
        if not system.answers["controllable"] and system.answers["stabilizable"]:
            answers["controllable"] = "stab."
        lines.append(
            _ROW.format(
                system.name[:38],
                system.n,
                answers["controllable"],
                f"{values['controllable']:.1e}",
                answers["observable"],
                f"{values['observable']:.1e}",
            )
        )
    lines.append("")
    lines += [wrap(sentence) for sentence in _skipped(study)]
    lines += [wrap(sentence) for sentence in _deficiencies(study.systems)]
    lines.append(wrap(_drake_text(study)))
    lines.append("det., stab.: fails, but only modes that decay: detectable, stabilisable")
    lines.append("mu: the delay in periods")
    return "\n".join(lines)


def hautus_page(study: HautusStudy, made: Provenance) -> Page:
    """The analysis as a page."""
    text, tone = verdict(study)
    sc, found = study.basis.experiment.scenario, study.basis
    sections = []
    chains = [system for name in _CHAINS for system in study.family(name)]
    if chains:
        sections.append(
            Section(
                "Delay chains",
                (*_CHAIN_TEXT, *_deficiencies(chains)),
                tables=[_systems_table(_landmarks(chains, sc.delay.steps), "Some delays.")],
                pictures=[
                    Picture(
                        chain_figure(study),
                        "Margins over the delay. Points at 1e-17 are rounding: there the paper's "
                        "chain is not observable. Each mark is one model.",
                    )
                ],
            )
        )
    plants = [*study.family("error model"), *study.family("plant")]
    if plants:
        shown = [*study.family("error model"), *_typical_plants(study)]
        sections.append(
            Section(
                "The plant and the paper's error model",
                ("The plant is held still at poses along the reference; the outputs are the pose.",)
                + tuple(_deficiencies(plants)),
                tables=[_systems_table(shown, "At home, and where the margin is least.")],
                pictures=[
                    Picture(plant_figure(study), "Margins of the plant along the reference.")
                ],
            )
        )
    if study.skipped:
        sections.append(Section("Left out", tables=[Table(("model", "reason"), study.skipped)]))
    sections.append(Section("Drake's answers", (_drake_text(study),)))
    if different := _drake_tables(study):
        sections.append(Section("Where Drake disagrees", tables=different, folded=True))
    sections.append(Section("How it is tested", _METHOD, folded=True))
    sections.append(Section("Every mode", tables=[_modes_table(study.systems)], folded=True))
    sections.append(Section("Every model", tables=[_systems_table(study.systems, "")], folded=True))
    motion = ", ".join(f"{value:.3g}" for value in found.motion)
    facts = {
        "mechanism": found.experiment.mechanism.name,
        "period, delay": f"{sc.controller.period:g} s, μ = {sc.delay.steps}, "
        f"fraction {sc.delay.fraction:g}",
        "units of the states": f"[{motion}] rad and m, these per s, these times s",
        "unit of the torques": f"{found.torque:.3g} N m",
    }
    return Page("Controllability and observability", text, sections, made, tone, facts)


def _chosen(study: HautusStudy) -> list[System]:
    """For the terminal: error model, chains without delay, at this and the longest, worst plant."""
    own = study.basis.experiment.scenario.delay.steps
    chosen = study.family("error model")
    for name in _CHAINS:
        chosen += _landmarks(study.family(name), own)
    return chosen + [worst for _, worst in _extremes(study)]


def _typical_plants(study: HautusStudy) -> list[System]:
    """Without and under gravity, the plant at home, which comes first, and where it is worst."""
    return [
        system
        for first, worst in _extremes(study)
        for system in ((first,) if first is worst else (first, worst))
    ]


def _extremes(study: HautusStudy) -> list[tuple[System, System]]:
    """First and worst plant without gravity and under it."""
    found = []
    for where in ("without", "under"):
        some = [s for s in study.family("plant") if s.name.startswith(f"plant {where} gravity")]
        if some:
            found.append((some[0], min(some, key=lambda system: system.margins["controllable"])))
    return found


def _landmarks(chains: list[System], own: int) -> list[System]:
    longest = max((system.steps or 0 for system in chains), default=0)
    return [system for system in chains if system.steps in (0, own, longest)]


def _deficiencies(systems: Iterable[System]) -> list[str]:
    """What fails, a sentence for each family and test, with the last model as the example."""
    families: dict[str, list[System]] = {}
    for system in systems:
        families.setdefault(system.family, []).append(system)
    sentences = []
    for family, some in families.items():
        for test, opening in (("reach", "no torque"), ("view", "no output")):
            failing = [system for system in some if getattr(system, test).deficient]
            if failing:
                words = [word for word in failing[-1].words if word.startswith(opening)]
                sentences.append(
                    f"{family[0].upper()}{family[1:]}: {len(failing)} of {len(some)} models fail "
                    f"here, such as {failing[-1].name}: {'; '.join(words)}."
                )
    return sentences


def _skipped(study: HautusStudy) -> list[str]:
    """What was left out, by reason."""
    reasons: dict[str, list[str]] = {}
    for name, reason in study.skipped:
        reasons.setdefault(reason, []).append(name)
    return [f"Left out, {reason}: {'; '.join(names)}." for reason, names in reasons.items()]


def _drake_text(study: HautusStudy) -> str:
    different = [system for system in study.systems if system.note]
    if not different:
        return "Drake's own tests agree on every model."
    return (
        f"Drake's own tests disagree on {len(different)} of {len(study.systems)} models, such as "
        f"{different[-1].name}: {different[-1].note}."
    )


def _drake_tables(study: HautusStudy) -> list[Table]:
    rows = [
        (system.name, f"{system.reach.margin:.1e}", f"{system.view.margin:.1e}", system.note)
        for system in study.systems
        if system.note
    ]
    columns = ("model", "controllability margin", "observability margin", "note")
    caption = "Where Drake's rank of matrix powers disagrees with the margins."
    return [Table(columns, rows, caption)] if rows else []


def _systems_table(systems: Iterable[System], caption: str) -> Table:
    rows = [
        (
            system.name,
            str(system.n),
            *(f"{_yes(system.answers[word])}, {system.margins[word]:.1e}" for word in QUESTIONS),
        )
        for system in systems
    ]
    return Table(("model", "n", *(f"{word}, margin" for word in QUESTIONS)), rows, caption)


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
    rows: list[tuple[str, ...]] = []
    for mode in test.modes:
        value = f"{mode.eigenvalue.real:.4g}"
        if mode.eigenvalue.imag:
            value += f" ± {mode.eigenvalue.imag:.4g}j"
        rows.append(
            (
                value,
                str(mode.multiplicity),
                _yes(mode.decays),
                f"{mode.margin:.1e}",
                str(mode.directions.shape[1]),
            )
        )
    return rows


def _yes(answer: bool) -> str:
    return "yes" if answer else "no"
