"""A robustness study as a table for a terminal and as a page."""

import math
from typing import Final

import numpy as np

from stewart_drake.report.failures_table import failures_sentence, failures_tables
from stewart_drake.report.page import Page, Picture, Provenance, Section, Table, Tone
from stewart_drake.report.robustness_figures import (
    SIGNIFICANT,
    TITLES,
    distribution_figure,
    influence_figure,
    runs_figure,
    times_figure,
    title,
)
from stewart_drake.report.tables import number, rows, wrap
from stewart_drake.studies.robustness_result import (
    FACTORS,
    QUANTILES,
    Influence,
    RobustnessStudy,
    factor_values,
    unit_of,
)
from stewart_drake.studies.statistics import Correlation, Interval, wilson_interval

_ROW: Final = "{:<20}{:>26}{:>17}{:>17}"
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
    "+1: the larger, the worse, in strict order; 0: no monotone relation; −1: the larger, the "
    "better. A quantity that hurts in both directions shows by its size, |...|. Hollow marks: "
    f"chance explains it (adjusted p above {SIGNIFICANT:g})."
)


def verdict(study: RobustnessStudy) -> tuple[str, Tone]:
    """The answer in a sentence or two, and how good it is."""
    total, kept = len(study.outcomes), int(np.sum(~study.failed))
    aim = "completed" if study.limit is None else f"completed with E_ac up to {study.limit:g} % s"
    text = f"{kept} of {total} runs {aim}: {percent(study.success)}. {_median(study)}"
    if study.undisturbed.status != "completed":
        text += " The undisturbed run failed already: " + study.undisturbed.reason + "."
    explanation = study.explanation
    strong = [title(one.factor) for one in explanation.found]
    if strong:
        text += f" What matters for {_aim(study)}: {', '.join(strong[:3])}."
    elif explanation.failing and explanation.others:
        text += f" For {_aim(study)} no single quantity matters beyond chance."
    errors = found(study.influences())
    if errors:
        text += f" What matters for E_ac, of those that completed: {', '.join(errors[:3])}."
    low = study.success.low
    return text, "good" if low >= _GOOD else "fair" if low >= _FAIR else "bad"


def found(influences: list[Influence]) -> list[str]:
    """Quantities whose influence on E_ac is beyond chance, the strongest first, each once."""
    strong = [one for one in influences if _or_one(one.error_p) < SIGNIFICANT]
    strong.sort(key=lambda one: -abs(one.error.rho))
    return list(dict.fromkeys(title(one.factor.strip("|")) for one in strong))


def _aim(study: RobustnessStudy) -> str:
    return "completing" if study.limit is None else "staying within the limit"


def _told(study: RobustnessStudy) -> str:
    """How the failing runs differ."""
    return failures_sentence(study.explanation, title, unit_of)


def robustness_table(study: RobustnessStudy) -> str:
    """Verdict, quantiles, failures and influences in 80 columns."""
    entries = {
        "E_ac": f"undisturbed {number(study.undisturbed.error)} % s; of all runs "
        + ", ".join(f"{100 * q:g} %: {_error(study.quantile(q).value)}" for q in QUANTILES)
    }
    if study.reasons:
        entries["failures"] = "; ".join(f"{reason} {n}" for reason, n in study.reasons.items())
    if told := _told(study):
        entries["who fails"] = told
    influences = study.influences()
    lines = [
        wrap(verdict(study)[0]),
        rows(entries),
        "",
        _ROW.format("rank correlation", "range drawn", "with E_ac", "with failing"),
    ]
    spans = _spans(study)
    for one in influences:
        span = "" if one.factor.startswith("|") else spans[one.factor]
        cells = (_rho(one.error, one.error_p), _rho(one.failure, one.failure_p))
        lines.append(_ROW.format(title(one.factor), span, *cells))
    lines += [
        "+: the larger, the worse; -: the larger, the better; |...|: by size, either way",
        f"*: beyond chance, adjusted p below {SIGNIFICANT:g}; a dash: all runs alike",
    ]
    return "\n".join(lines)


def robustness_page(study: RobustnessStudy, made: Provenance) -> Page:
    """The study as a page."""
    text, tone = verdict(study)
    sc, influences = study.experiment.scenario, study.influences()
    sections = [
        Section(
            "Accumulated error",
            tables=[_quantile_table(study)],
            pictures=[
                Picture(
                    distribution_figure(study),
                    "Share of all runs with at most this error. The curve ends below 100 % where "
                    "runs did not complete.",
                )
            ],
        ),
        Section(
            "What matters",
            (_MATTERS,),
            [_influence_table(influences)],
            [
                Picture(influence_figure(influences), "Rank correlations with 95 % intervals."),
                Picture(
                    runs_figure(study),
                    "Every run over every drawn quantity; in the strip on top, runs that did not "
                    "complete. Quantities with a sign are true less believed.",
                ),
            ],
        ),
    ]
    if study.failed.any():
        sections.append(_failures(study))
    sections += [
        Section("What was drawn", _METHOD, [_range_table(study)]),
        Section("Worst runs", tables=[_worst_table(study)], folded=True),
    ]
    facts = {
        "mechanism": study.experiment.mechanism.name,
        "start": f"{sc.start.replace('_', ' ')}, torques in flight: {sc.queue}",
        "delay": f"{sc.eta:g} s",
        "runs": f"{len(study.outcomes)}, seed {study.seed}, {sc.plant.kind} plant",
        "undisturbed E_ac": f"{number(study.undisturbed.error)} % s",
    }
    return Page(
        f"Robustness of {study.experiment.mechanism.name}", text, sections, made, tone, facts
    )


def percent(share: Interval) -> str:
    """A share with its interval."""
    interval = f"{_percent(share.low)} to {_percent(share.high)} %"
    return f"{_percent(share.value)} % (95 % interval {interval})"


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"


def _median(study: RobustnessStudy) -> str:
    middle = study.quantile(0.5).value
    if math.isinf(middle):
        return "Half of the runs or more did not complete."
    most = study.quantile(0.95).value
    end = "" if math.isinf(most) else f", 95 % below {number(most)}"
    return f"Half of all runs stay below E_ac = {number(middle)} % s{end}."


def _error(value: float) -> str:
    return "failed" if value == math.inf else number(value)


def _rho(one: Correlation, p: float) -> str:
    if math.isnan(one.rho):
        return "-  "
    return f"{one.rho:+.2f} {'*' if p < SIGNIFICANT else ' '}"


def _or_one(p: float) -> float:
    return 1.0 if math.isnan(p) else p


def _spans(study: RobustnessStudy) -> dict[str, str]:
    """What was in fact drawn, from least to most."""
    spans = {}
    for name, values in factor_values(study.draws).items():
        if name in FACTORS:
            spans[name] = f"{_span(float(values.min()), float(values.max()))} {FACTORS[name]}"
    return spans


def _span(low: float, high: float) -> str:
    if math.isinf(high):
        return "no"
    if low == high:
        return f"always {number(low)}"
    decimals = max(0, 1 - math.floor(math.log10(max(abs(low), abs(high)))))
    return f"{low:.{decimals}f} to {high:.{decimals}f}"


def _quantile_table(study: RobustnessStudy) -> Table:
    table_rows = []
    for q in QUANTILES:
        one = study.quantile(q)
        low = "-" if math.isinf(one.low) and one.low < 0 else _error(one.low)
        high = "failed or unknown" if math.isinf(one.high) else number(one.high)
        table_rows.append((f"{100 * q:g} %", _error(one.value), low, high))
    columns = ("of all runs", "E_ac at most, % s", "interval from", "to")
    return Table(columns, table_rows, "Quantiles; a run that did not complete counts as infinite.")


def _influence_table(influences: list[Influence]) -> Table:
    def cells(one: Correlation, p: float) -> tuple[str, str, str]:
        if math.isnan(one.rho):
            return "-", "-", "-"
        return f"{one.rho:+.2f}", f"{one.low:+.2f} to {one.high:+.2f}", f"{p:.2g}"

    columns = ("quantity", "ρ with E_ac", "interval", "adjusted p", "ρ with failing", "interval",
               "adjusted p")  # fmt: skip
    table_rows = [
        (
            title(one.factor),
            *cells(one.error, one.error_p),
            *cells(one.failure, one.failure_p),
        )
        for one in influences
    ]
    return Table(columns, table_rows, "Dashes: one of the two was the same in all runs.")


def _failures(study: RobustnessStudy) -> Section:
    total = len(study.outcomes)
    table_rows = []
    for reason, n in study.reasons.items():
        own = [one for one in study.outcomes if study.reason_of(one) == reason]
        times = [one.time for one in own if math.isfinite(one.time)]
        legs = sorted({one.leg for one in own if one.leg is not None})
        shares = [f"leg {leg}: {sum(one.leg == leg for one in own)}" for leg in legs]
        table_rows.append(
            (
                reason,
                str(n),
                percent(wilson_interval(n, total)),
                number(float(np.median(times))) if times else "-",
                ", ".join(shares) or "-",
            )
        )
    columns = ("reason", "runs", "share of all", "median time, s", "legs")
    early = any(one.status != "completed" for one in study.outcomes)
    pictures = [Picture(times_figure(study), "When runs ended early.")] if early else []
    tables = [Table(columns, table_rows)]
    told = _told(study)
    if told:
        tables += failures_tables(study.explanation, title, unit_of)
    return Section("Failures", (told,) if told else (), tables, pictures)


def _range_table(study: RobustnessStudy) -> Table:
    spans = _spans(study)
    table_rows = [(TITLES[name], spans[name]) for name in FACTORS]
    r = study.ranges
    caption = (
        f"In fact drawn. Asked for with --vary: payload={r.payload:g}, "
        f"torque_bias={r.torque_bias:g}, noise={r.noise:g}, torque_limit={r.torque_limit}, "
        f"damping={r.damping:g}, delay={r.delay:g}, delay_steps={r.delay_steps}, "
        f"lengths={r.lengths:g}, anchors={r.anchors:g}."
    )
    return Table(("quantity", "from, to"), table_rows, caption)


def _worst_table(study: RobustnessStudy) -> Table:
    values = factor_values(study.draws)
    order = np.argsort(np.where(np.isnan(study.errors), np.inf, study.errors), kind="stable")[::-1]
    table_rows = []
    for i in order[:_WORST]:
        one = study.outcomes[i]
        how = number(one.error) if one.status == "completed" else f"ends at {one.time:.2f} s"
        cells = (f"{values[name][i]:.3g}" for name in FACTORS)
        table_rows.append((str(i), how, *cells))
    columns = ("run", "E_ac, % s", *(f"{TITLES[n]}, {unit}" for n, unit in FACTORS.items()))
    return Table(columns, table_rows, "All runs are in runs.csv.")
