"""The analyses of a scenario, and the search for a machine: what studies it, what is told of it."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final, NamedTuple

from stewart_drake.files.schema import plain
from stewart_drake.reporting import (
    delay_document,
    hautus_document,
    layout_document,
    link_document,
    robustness_document,
    workspace_document,
)
from stewart_drake.reporting.answer import Answer, answer_of
from stewart_drake.reporting.document import Document
from stewart_drake.scenario.link import link_text
from stewart_drake.studies.delay_limits import study_delay
from stewart_drake.studies.hautus import study_hautus
from stewart_drake.studies.layout import study_layout
from stewart_drake.studies.link_bound import study_link
from stewart_drake.studies.robustness import study_robustness
from stewart_drake.studies.workspace import study_workspace


class Analysis(NamedTuple):
    """One of them.

    `study` is called with the scenario and options; what it returns has a `summary`, plain data.
    """

    study: Callable[..., Any]
    document: Callable[[Any], Document]


ANALYSES: Final = {
    "delay": Analysis(study_delay, delay_document.document),
    "hautus": Analysis(study_hautus, hautus_document.document),
    "layout": Analysis(study_layout, layout_document.document),
    "link": Analysis(study_link, link_document.document),
    "workspace": Analysis(study_workspace, workspace_document.document),
    "robustness": Analysis(study_robustness, robustness_document.document),
}
"""By the word after `analyze`; `layout` is a command of its own."""


def analyze(name: str, *subject: Any, command: str, **options: Any) -> Answer:
    """Study a scenario.

    Args:
        name: of the analysis.
        subject: the scenario, and what else the study takes by position.
        command: what does the same again, as typed.
        options: of the study.
    """
    analysis, scenario = ANALYSES[name], subject[0]
    found = answer_of(lambda: analysis.study(*subject, **options), analysis.document, command)
    facts = {"link": text} if (text := link_text(scenario)) else {}
    return replace(
        found,
        summary=found.summary | {"link": plain(scenario.assumed_link)},
        document=replace(found.document, facts={**facts, **found.document.facts}),
    )
