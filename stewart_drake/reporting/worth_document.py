"""What is told of a tuner's worth: who did how well, where, at what price, and how it went."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from stewart_drake.reporting.document import (
    Document,
    Paragraph,
    Picture,
    Section,
    Table,
    Tone,
    Values,
)
from stewart_drake.reporting.words import number
from stewart_drake.reporting.worth_figures import distributions, runs_of_each_kind
from stewart_drake.studies.families import FAULTS
from stewart_drake.tuning.worth import FIXED, HINDSIGHT, RULE, Worth

_HOW = (
    "J is E_ac up to the end plus 50 % s for each second without a plate; g its geometric mean, m "
    "its mean. Below best: by how much g is below that of the best fixed ratio of these very "
    "conditions, m below that of the best by m; below rule: g below the rule's. 95 % by a paired "
    "bootstrap over conditions. Hindsight is the best fixed ratio of each condition."
)


def worth_document(worth: Worth) -> Document:
    """Tables of the candidates, the price on the undisturbed scenario, and figures."""
    s = worth.summary
    tuners = [name for name in worth.names if name not in FIXED]
    return Document(
        f"Worth of a tuner, family {worth.family}",
        _verdict(worth, [name for name in tuners if name != RULE]),
        [
            Section("Candidates", _candidates(worth), Paragraph(_HOW)),
            Section("By fault", _faults(worth)),
            Section("Price where nothing is wrong", _nominal(worth)),
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
                    partial(runs_of_each_kind, worth),
                    "One run for each fault. Grey: the fixed ratio that is best there.",
                ),
            ),
        ],
        tone=_tone(s, [name for name in tuners if name != RULE]),
    )


def _tone(summary: Mapping[str, Any], networks: Sequence[str]) -> Tone:
    if not networks:
        return "plain"
    gains = [summary["gains"][name]["g"] for name in networks]
    if any(high < 0 for _, _, high in gains):
        return "bad"
    return "good" if all(low > 0 for _, low, _ in gains) else "fair"


def _verdict(worth: Worth, networks: Sequence[str]) -> str:
    s = worth.summary
    best = s["best_g"]
    told = [
        f"{name} is {_share(s['gains'][name]['g'])} below the best fixed ratio, {best}"
        for name in networks or [RULE]
    ]
    return f"{'; '.join(told)} ({s['conditions']} conditions {s['family']})"


def _share(gain: Sequence[float]) -> str:
    value, low, high = (100 * x for x in gain)
    return f"{value:.0f} % ({low:.0f} to {high:.0f})"


def _candidates(worth: Worth) -> Table:
    s, rows = worth.summary, []
    for name in (*worth.names, HINDSIGHT):
        one, gains = s["candidates"][name], s["gains"].get(name)
        marks = "".join(f" {m}" for m in ("g", "m") if s[f"best_{m}"] == name)
        shares = [_share(gains[key]) for key in ("g", "m", "rule")] if gains else ["", "", ""]
        rows.append(
            (
                f"{name}{marks and ' best' + marks}",
                str(one["completed"]),
                number(one["g"]),
                number(one["m"]),
                *shares,
            )
        )
    heads = ("log10 w_Q/w_R", "completed", "g", "m", "g below best", "m below best", "below rule")
    return Table(heads, rows, brief=True)


def _faults(worth: Worth) -> Table:
    s = worth.summary
    names = [name for name in (*worth.names, HINDSIGHT) if name not in FIXED]
    rows = [
        (name, *(_share(s["by_fault"][f][name]) if s["by_fault"][f] else "" for f in FAULTS))
        for name in names
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


def curves_document(summary: Mapping[str, Any]) -> Document:
    """What each fixed ratio came to."""
    rows = [(name, str(summary["completed"][name]), number(g)) for name, g in summary["g"].items()]
    verdict = (
        f"{summary['conditions']} conditions of family {summary['family']}; with the best ratio of "
        f"each g is {number(summary['hindsight'])} % s"
    )
    table = Table(("log10 w_Q/w_R", "completed", "g"), rows, brief=True)
    return Document("Data of a family", verdict, [Section("", table)])


def regret_document(summary: Mapping[str, Any]) -> Document:
    """What was trained on what, and what it is worth where it was not trained."""
    held, entries = summary["held_out_J"], {}
    entries["conditions"] = f"{summary['conditions']}, {summary['held_out']} of them held out"
    entries["g held out"] = (
        f"round 1 {number(held['rounds'][0])}, round 2 {number(held['rounds'][1])}, best fixed "
        f"{number(held['best_fixed'])}, hindsight {number(held['hindsight'])}"
    )
    entries["kept"] = f"round {summary['round']}"
    return Document("Training by regret", "", [Section("", Values(entries))])
