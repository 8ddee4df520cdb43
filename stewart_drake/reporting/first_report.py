"""First report on a new machine: its drawing, its check, and a run of the proposed motion."""

from collections.abc import Iterable

from stewart_drake.loop.results import SimulationResult
from stewart_drake.reporting import mechanism, run
from stewart_drake.reporting.document import Document, Paragraph, Picture, Section, sentence
from stewart_drake.reporting.figures import draw_run
from stewart_drake.studies.new_machine import NewMachine


def first_report(made: NewMachine, result: SimulationResult, findings: Iterable[str]) -> Document:
    """Return the report.

    Args:
        made: the machine.
        result: run of its scenario.
        findings: about the motors, the loop and its delay, in sentences.
    """
    check, completed = made.check, result.status == "completed"
    about, ran = mechanism.document(check), run.run_document(result)
    drawing = Picture(
        lambda: mechanism.mechanism_figure(check.mechanism), "The machine at its home pose."
    )
    figures = [
        Picture(figure, f"{name.capitalize()}.") for name, figure in draw_run(result).items()
    ]
    motion = "Up and down by a quarter of the travel, once in two seconds."
    return Document(
        f"First report on {check.mechanism.name}",
        " ".join(sentence(text) for text in (check.verdict, *findings)),
        [
            Section("The machine", drawing, *(b for s in about.sections for b in s.blocks)),
            Section(
                "A first run",
                Paragraph(motion),
                *(b for s in ran.sections for b in s.blocks),
                *figures,
            ),
        ],
        "good" if completed else "bad",
    )
