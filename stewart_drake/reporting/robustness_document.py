"""What is told of a robustness study."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Final

import numpy as np

from stewart_drake.reporting.document import (
    Block,
    Document,
    Paragraph,
    Picture,
    Section,
    Table,
    Tone,
)
from stewart_drake.reporting.failures_words import failures_sentence, failures_tables
from stewart_drake.reporting.robustness_figures import (
    SIGNIFICANT,
    TITLES,
    distribution_figure,
    influence_figure,
    runs_figure,
    times_figure,
    title,
)
from stewart_drake.reporting.words import number
from stewart_drake.studies.robustness_result import (
    QUANTILES,
    Influence,
    RobustnessStudy,
    factor_values,
    factors,
    unit_of,
)
from stewart_drake.studies.statistics import Correlation, Interval, wilson_interval

_GOOD, _FAIR = 0.99, 0.9
"""Lower end of the success rate for these tones."""
_WORST: Final = 10
"""Runs listed one by one."""

_METHOD: Final = (
    "Each run simulates one machine whose properties are drawn at random, all at once and "
    "independently of each other, in the ranges below. The controller is told the torque limit and "
    "how noisy the sensor is, and believes the rest to be as the scenario says; its estimator, "
    "where there is one, has to find out. Draw i depends on the seed and on i alone.",
    "Success rates carry Wilson's score interval, quantiles the interval of order statistics, rank "
    "correlations (Spearman) Fisher's; all are 95 % intervals. p-values are Holm's, adjusted for "
    "the number of quantities asked about. A run that did not complete counts as infinitely bad in "
    "the quantiles of all runs, and is in no average.",
)
_MATTERS: Final = (
    "Rank correlations. +: the larger, the worse, +1 in strict order; -: the larger, the better; "
    "|...|: by size, which shows what hurts in both directions. *, full marks in the figure: "
    f"beyond chance, adjusted p below {SIGNIFICANT:g}. A dash: the same in all runs."
)
_SAME: Final = (
    "Each drawn machine under each controller. Quantiles are of E_ac, over all runs; undisturbed "
    "is the run in which nothing was drawn."
)
_QUANTILES: Final = "Quantiles; a run that did not complete counts as infinite."
_CURVE: Final = (
    "Share of all runs with at most this error. The curve ends below 100 % where runs did not "
    "complete."
)
_EVERY_RUN: Final = (
    "Every run over every drawn quantity; in the strip on top, runs that did not complete. "
    "Quantities with a sign are true less believed."
)


def document(study: RobustnessStudy) -> Document:
    """Success rate, quantiles, what matters, failures, and the worst runs."""
    verdict, tone = _verdict(study)
    sc, influences = study.experiment.scenario, study.influences()
    undisturbed = f"{number(study.undisturbed.error)} % s"
    matters = Section(
        "What matters",
        _influence_table(study, influences),
        Paragraph(_MATTERS, brief=True),
        Picture(partial(influence_figure, influences), "Rank correlations, 95 % intervals."),
        Picture(partial(runs_figure, study), _EVERY_RUN),
    )
    error = Section(
        "Accumulated error",
        _quantile_table(study),
        Paragraph(f"The undisturbed run has E_ac = {undisturbed}.", brief=True),
        Picture(partial(distribution_figure, study), _CURVE),
    )
    sections = [error, matters]
    if study.beside:
        sections.insert(0, _beside(study))
    if study.failed.any():
        sections.append(_failures(study))
    sections += [
        Section("What was drawn", *_METHOD, _range_table(study)),
        Section("Worst runs", _worst_table(study), folded=True),
    ]
    facts = {
        "mechanism": study.experiment.mechanism.name,
        "start": f"{sc.start.replace('_', ' ')}, torques in flight: {sc.queue}",
        "delay": f"{sc.eta:g} s",
        "runs": f"{len(study.outcomes)}, seed {study.seed}, {sc.plant.kind} plant",
    }
    if study.loops:
        facts["loop"] = ", ".join(f"{loop}: {n}" for loop, n in study.loops.items())
    name = study.experiment.mechanism.name
    return Document(f"Robustness of {name}", verdict, sections, tone, facts)


def _beside(study: RobustnessStudy) -> Section:
    """The same machines under each controller, the one that is asked about first."""
    rows = []
    for name, one in {"as asked": study, **study.others}.items():
        median, most = one.quantile(0.5).value, one.quantile(0.95).value
        kept = int(np.sum(~one.failed))
        cells = (f"{kept} of {len(one.outcomes)}", _percent(one.success))
        rows.append((name, number(one.undisturbed.error), *cells, _failed(median), _failed(most)))
    columns = ("controller", "undisturbed, % s", "runs kept", "share", "median, % s", "95 %, % s")
    brief = ("controller", "alone", "runs kept", None, "median", "95 %")
    return Section("Controllers", _SAME, Table(columns, rows, brief=brief))


def _verdict(study: RobustnessStudy) -> tuple[str, Tone]:
    """The answer in a sentence or two, and how good it is."""
    total, kept = len(study.outcomes), int(np.sum(~study.failed))
    aim = "completed" if study.limit is None else f"completed with E_ac up to {study.limit:g} % s"
    text = f"{kept} of {total} runs {aim}: {_percent(study.success)}. {_median(study)}"
    explanation = study.explanation
    strong = [title(one.factor) for one in explanation.found]
    aim = "completing" if study.limit is None else "staying within the limit"
    if strong:
        text += f" What matters for {aim}: {', '.join(strong[:3])}."
    elif explanation.failing and explanation.others:
        text += f" For {aim} no single quantity matters beyond chance."
    errors = [one for one in study.influences() if one.error_p < SIGNIFICANT]
    errors.sort(key=lambda one: -abs(one.error.rho))
    names = list(dict.fromkeys(title(one.factor.strip("|")) for one in errors))
    if names:
        text += f" What matters for E_ac, of those that completed: {', '.join(names[:3])}."
    for name, one in study.others.items():
        n = int(np.sum(~one.failed))
        text += f" With {name}, on the same machines: {n} of {total}."
    low = study.success.low
    return text, "good" if low >= _GOOD else "fair" if low >= _FAIR else "bad"


def _percent(share: Interval) -> str:
    """A share with its interval."""
    value, low, high = (f"{100 * part:.1f}" for part in (share.value, share.low, share.high))
    return f"{value} % (95 % interval {low} to {high} %)"


def _median(study: RobustnessStudy) -> str:
    middle = study.quantile(0.5).value
    if math.isinf(middle):
        return "Half of the runs or more did not complete."
    most = study.quantile(0.95).value
    end = "" if math.isinf(most) else f", 95 % below {number(most)}"
    return f"Half of all runs stay below E_ac = {number(middle)} % s{end}."


def _spans(study: RobustnessStudy) -> dict[str, str]:
    """What was in fact drawn, from least to most; nothing for sizes."""
    values, told = factor_values(study.draws), factors(study.draws)
    return {
        name: f"{_span(float(x.min()), float(x.max()))} {told[name]}" if name in told else ""
        for name, x in values.items()
    }


def _span(low: float, high: float) -> str:
    if math.isinf(high):
        return "no"
    if low == high:
        return f"always {number(low)}"
    decimals = max(0, 1 - math.floor(math.log10(max(abs(low), abs(high)))))
    return f"{low:.{decimals}f} to {high:.{decimals}f}"


def _quantile_table(study: RobustnessStudy) -> Table:
    rows = []
    for q in QUANTILES:
        one = study.quantile(q)
        high = "failed or unknown" if math.isinf(one.high) else number(one.high)
        low = "-" if math.isinf(one.low) and one.low < 0 else _failed(one.low)
        rows.append((f"{100 * q:g} %", _failed(one.value), low, high))
    columns = ("of all runs", "E_ac at most, % s", "interval from", "to")
    return Table(columns, rows, _QUANTILES, brief=True)


def _influence_table(study: RobustnessStudy, influences: Sequence[Influence]) -> Table:
    def cells(one: Correlation, p: float) -> tuple[str, str, str]:
        if math.isnan(one.rho):
            return "-", "-", "-"
        mark = "* " if p < SIGNIFICANT else ""
        return f"{mark}{one.rho:+.2f}", f"{one.low:+.2f} to {one.high:+.2f}", f"{p:.2g}"

    spans = _spans(study)
    rows = [
        (title(one.factor), spans[one.factor], *cells(one.error, one.error_p),
         *cells(one.failure, one.failure_p))
        for one in influences
    ]  # fmt: skip
    columns = ("quantity", "drawn", "ρ with E_ac", "interval", "adjusted p", "ρ with failing",
               "interval", "adjusted p")  # fmt: skip
    brief = ("quantity", "drawn", "with E_ac", None, None, "with failing", None, None)
    return Table(columns, rows, brief=brief)


def _failures(study: RobustnessStudy) -> Section:
    total = len(study.outcomes)
    rows = []
    for reason, n in study.reasons.items():
        own = [one for one in study.outcomes if study.reason_of(one) == reason]
        times = [one.time for one in own if math.isfinite(one.time)]
        legs = sorted({one.leg for one in own if one.leg is not None})
        shares = [f"leg {leg}: {sum(one.leg == leg for one in own)}" for leg in legs]
        rows.append(
            (
                reason,
                str(n),
                _percent(wilson_interval(n, total)),
                number(float(np.median(times))) if times else "-",
                ", ".join(shares) or "-",
            )
        )
    columns = ("reason", "runs", "share of all", "median time, s", "legs")
    brief = ("reason", "runs", None, "median time, s", "legs")
    parts: list[Block | str] = [Table(columns, rows, brief=brief)]
    told = failures_sentence(study.explanation, title, unit_of)
    if told:
        parts.append(Paragraph(told, brief=True))
        parts += failures_tables(study.explanation, title, unit_of)
    if any(one.status != "completed" for one in study.outcomes):
        parts.append(Picture(partial(times_figure, study), "When runs ended early."))
    return Section("Failures", *parts)


def _range_table(study: RobustnessStudy) -> Table:
    spans = _spans(study)
    r = study.ranges
    caption = (
        f"In fact drawn. Asked for with --vary: payload={r.payload:g}, "
        f"torque_bias={r.torque_bias:g}, noise={r.noise:g}, torque_limit={r.torque_limit}, "
        f"damping={r.damping:g}, delay={r.delay:g}, delay_steps={r.delay_steps}, "
        f"lengths={r.lengths:g}, anchors={r.anchors:g}, coulomb={r.coulomb:g}, "
        f"payload_position={r.payload_position:g}, jitter={r.jitter:g}, loss={r.loss:g}."
    )
    rows = [(TITLES[name], spans[name]) for name in factors(study.draws)]
    return Table(("quantity", "from, to"), rows, caption)


def _worst_table(study: RobustnessStudy) -> Table:
    values, told = factor_values(study.draws), factors(study.draws)
    order = np.argsort(np.where(np.isnan(study.errors), np.inf, study.errors), kind="stable")[::-1]
    rows = []
    for i in order[:_WORST]:
        one = study.outcomes[i]
        how = number(one.error) if one.status == "completed" else f"ends at {one.time:.2f} s"
        rows.append((str(i), how, *(f"{values[name][i]:.3g}" for name in told)))
    columns = ("run", "E_ac, % s", *(f"{TITLES[n]}, {unit}" for n, unit in told.items()))
    return Table(columns, rows, "All runs are in runs.csv.")


def _failed(error: float) -> str:
    return "failed" if error == math.inf else number(error)
