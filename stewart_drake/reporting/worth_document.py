"""Document on a tuner's worth: the candidates, where, at what price, and how it went."""

from collections.abc import Sequence
from functools import partial

from stewart_drake.reporting.document import (
    Document,
    Paragraph,
    Picture,
    Section,
    Table,
    Tone,
)
from stewart_drake.reporting.words import number
from stewart_drake.reporting.worth_figures import distributions, weights_over_time
from stewart_drake.studies.families import FAULTS
from stewart_drake.tuning.worth import HINDSIGHT, RULE, Worth

_HOW = (
    "J is E_ac up to the end plus 50 % s for each second without a plate; g its geometric mean, m "
    "its mean. Below best: by how much g is below that of the best fixed gain of these very "
    "conditions, m below that of the best by m; below rule: g below the rule's. 95 % by a paired "
    "bootstrap over conditions. Hindsight is the best fixed gain of each condition."
)


def worth_document(worth: Worth) -> Document:
    """Return tables of the candidates by J and by E_ac, and figures.

    A terminal shows those by J of a family with faults, those by E_ac of another one.
    """
    faulty = worth.family.has_faults
    sections = [
        Section("Candidates", _by_cost(worth), Paragraph(_HOW)),
        Section("Where all complete", _by_error(worth), Paragraph(_error_text(worth), not faulty)),
    ]
    if faulty:
        sections += [
            Section("By fault", _faults(worth)),
            Section("Price where nothing is wrong", _nominal(worth)),
        ]
    sections += [
        Section(
            "Distribution",
            Picture(
                partial(distributions, worth),
                "Share of the conditions whose J is at most so much; further left is better.",
            ),
        ),
        Section(
            "Weights over time",
            Picture(
                partial(weights_over_time, worth),
                "One run for each fault. Grey: the fixed ratio that is best there."
                if faulty
                else "The first conditions. Grey: the fixed ratio that is best there.",
            ),
        ),
    ]
    name = worth.family.name
    title = f"Worth of a tuner, family {name}" if faulty else "Evaluation of the tuner"
    if not faulty:
        return Document(title, "", sections)
    return Document(title, _verdict(worth), sections, tone=_tone(worth))


def _networks(worth: Worth) -> list[str]:
    return [name for name in worth.tuners if name != RULE]


def _tone(worth: Worth) -> Tone:
    gains = [worth.summary["gains"][name]["g"] for name in _networks(worth)]
    if any(high < 0 for _, _, high in gains):
        return "bad"
    return "good" if all(low > 0 for _, low, _ in gains) else "fair"


def _verdict(worth: Worth) -> str:
    s = worth.summary
    told = [
        f"{name} is {_share(s['gains'][name]['g'])} below the best fixed gain, {s['best_g']}"
        for name in _networks(worth)
    ]
    return f"{'; '.join(told)} ({s['conditions']} conditions {worth.family.name})"


def _share(gain: Sequence[float]) -> str:
    value, low, high = (100 * x for x in gain)
    return f"{value:.0f} % ({low:.0f} to {high:.0f})"


def _by_cost(worth: Worth) -> Table:
    s, rows = worth.summary, []
    measures = ("g", "m", "rule") if RULE in worth.names else ("g", "m")
    for name in (*worth.names, HINDSIGHT):
        one, gains = s["candidates"][name], s["gains"].get(name)
        marks = "".join(f" {m}" for m in ("g", "m") if s[f"best_{m}"] == name)
        shares = [_share(gains[key]) if gains else "" for key in measures]
        label = f"{name}{marks and ' best' + marks}"
        rows.append((label, str(one["completed"]), number(one["g"]), number(one["m"]), *shares))
    below = ("g below best", "m below best", "below rule")[: len(measures)]
    return Table((_head(worth), "completed", "g", "m", *below), rows, brief=worth.family.has_faults)


def _by_error(worth: Worth) -> Table:
    s, rows = worth.summary, []
    for name in worth.names:
        one = s["candidates"][name]
        low, high = map(number, one["interval"])
        mark = " *" if name == s["best_fixed"] else ""
        rows.append((f"{name}{mark}", str(one["failures"]), number(one["mean"]),
                     f"{low} to {high}", number(one["worst"])))  # fmt: skip
    columns = (_head(worth), "failures", "mean E_ac", "95 % interval", "worst")
    return Table(columns, rows, brief=not worth.family.has_faults)


def _error_text(worth: Worth) -> str:
    s, tuner = worth.summary, worth.names[-1]
    low, high = (f"{-100 * x:+.1f}" for x in reversed(s["improvement_interval"]))
    extra = s["candidates"][tuner]["failures"] - s["candidates"][s["best_fixed"]]["failures"]
    return (
        f"E_ac in % s over the {s['common']} of {s['conditions']} conditions that all complete; "
        f"* best fixed gain. Against it the mean of {tuner} is {-100 * s['improvement']:+.1f} % "
        f"(95 %: {low} to {high}), with {extra:+d} failures; that of the best gain of each "
        f"condition, picked in hindsight, {-100 * s['hindsight']:+.1f} %."
    )


def _head(worth: Worth) -> str:
    return "log10 w_Q/w_R" if worth.family.has_faults else "w_Q / w_R"


def _faults(worth: Worth) -> Table:
    s = worth.summary
    rows = [
        (name, *(_share(s["by_fault"][f][name]) if s["by_fault"][f] else "" for f in FAULTS))
        for name in (*worth.tuners, HINDSIGHT)
    ]
    caption = f"g below that of {s['best_g']}, under the conditions of each fault."
    return Table(("", *FAULTS), rows, caption, brief=True)


def _nominal(worth: Worth) -> Table:
    rows = [
        (name, number(one["on_reference"]), number(one["from_rest"]))
        for name, one in worth.summary["nominal"].items()
    ]
    caption = "E_ac in % s of `paper` as it is; default is w_Q = w_R = 1."
    return Table(("", "on the reference", "from rest"), rows, caption, brief=True)
