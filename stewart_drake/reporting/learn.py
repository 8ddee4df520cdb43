"""Document, figure and file of learning from repetitions."""

from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from stewart_drake.loop.learned import save_learned
from stewart_drake.reporting.document import Document, Frame, from_template
from stewart_drake.reporting.panels import Curve, Panel, draw
from stewart_drake.reporting.replay import replay_html
from stewart_drake.reporting.style import TORQUES, line, unit_for
from stewart_drake.studies.learn import LearnStudy, Repetition


def document(study: LearnStudy) -> Document:
    first, best = study.repetitions[0], study.best
    numbers = {id(one): k for k, one in enumerate(study.repetitions, 1)}
    shown = [first] if best is first else [first, best]
    machine, scenario = study.experiment.truth, study.experiment.scenario
    largest = [one.largest for one in study.repetitions if one.learned]
    unit, factor = ("rad", 1.0) if study.setpoints else unit_for(largest, TORQUES)
    return from_template(
        "learn",
        "bad" if best.result.stopped else "plain" if best is first else "good",
        study=study,
        of_largest=unit,
        factor=factor,
        first=first,
        best=best,
        learned=best is not first,
        on_reference=(scenario.start, scenario.queue) == ("on_reference", "reference"),
        number=lambda one: numbers[id(one)],
        films=[
            Frame(partial(replay_html, one.result, machine, title), title.replace(" ", "_"))
            for one in shown
            for title in [f"repetition {numbers[id(one)]}"]
        ],
        errors=partial(error_figure, study),
        over_time=partial(time_figure, study),
    )


def write(study: LearnStudy, folder: Path) -> list[str]:
    """Write the learned torque of the best repetition, if any; return the name of its file."""
    (folder / study.file).unlink(missing_ok=True)  # of an earlier command
    learned = study.best.learned
    if learned is None:
        return []
    save_learned(folder / study.file, learned, study.experiment)
    return [study.file]


def error_figure(study: LearnStudy) -> Figure:
    errors = [one.error for one in study.repetitions]
    curve = Curve(np.arange(1, len(errors) + 1), errors, "", line(0))
    name = "{}  [{}]".format(*study.measure).removeprefix("the ")

    def paint(ax: Axes) -> None:
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))

    return draw([Panel(name, [curve], "repetition", yscale="log", height=2.5, paint=paint)])


def time_figure(study: LearnStudy) -> Figure:
    def curve(k: int, one: Repetition) -> Curve:
        signals = one.result.signals
        mean = 100 * np.mean(np.abs(signals.error.values) / study.experiment.scale, axis=1)
        return Curve(signals.time.values, mean, f"repetition {k + 1}", line(k, marked=False))

    curves = [curve(k, one) for k, one in enumerate(study.repetitions)]
    marks = {study.repetitions[0].result.scenario.duration - study.period: "last period begins"}
    return draw([Panel("mean error  [%]", curves, marks=marks, yscale="powers", height=2.5)])
