"""Results of runs, comparisons and analyses, with methods that show and save them.

`loop` and `studies` return plain results, which the public functions convert to these classes.
"""

import html as escaping
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pandas
import xarray

from stewart_drake.files.arrayio import write_netcdf
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import remove_partials, write_asked, write_whole
from stewart_drake.files.jsonio import write_json
from stewart_drake.loop import controller_margin as loop_margin
from stewart_drake.loop import results as loop_results
from stewart_drake.loop.preparation import simulated_machine
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.reporting.csv_file import columns_of
from stewart_drake.reporting.document import (
    PAGE,
    Caution,
    Document,
    Frame,
    Picture,
    from_template,
    wrap,
)
from stewart_drake.reporting.run import comparison_document, run_document
from stewart_drake.studies import new_machine
from stewart_drake.studies.verdict import Verdict, loop_verdict, milliseconds

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pydrake.geometry import Meshcat

    from stewart_drake.reporting.page import Provenance


class Figures(dict[str, "Figure"]):
    """Figures by name, shown by a notebook."""

    def _repr_html_(self) -> str:
        from stewart_drake.reporting.page import source

        return "\n".join(
            f'<img src="{source(figure)}" alt="{escaping.escape(name)}">'
            for name, figure in self.items()
        )

    def __repr__(self) -> str:
        return f"Figures({', '.join(self)})"


class Printed:
    """A result that prints as its table."""

    __slots__ = ()

    def table(self) -> str:
        """Return the text that the command prints."""
        raise NotImplementedError

    def __str__(self) -> str:
        return self.table()


class Replay:
    """The animation of a run as HTML, shown by a notebook."""

    def __init__(self, text: str) -> None:
        self.html = text

    def __repr__(self) -> str:
        return f"Replay({len(self.html) / 1e6:.1f} MB of HTML)"

    def _repr_html_(self) -> str:
        return _framed(self.html)


class SimulationResult(Printed, loop_results.SimulationResult):
    __doc__ = loop_results.SimulationResult.__doc__

    @classmethod
    def of(cls, result: loop_results.SimulationResult) -> "SimulationResult":
        return cls(**vars(result))

    def table(self) -> str:
        """Return status, errors and torques as text."""
        return run_document(self).plain()

    def to_pandas(self) -> pandas.DataFrame:
        """Return the signals over `time[s]`, with a column per component as in the CSV file."""
        header, rows = columns_of(self.signals)
        return pandas.DataFrame(rows, columns=header).set_index(header[0])

    def to_xarray(self) -> xarray.Dataset:
        """Return a copy of the signals, over `time` in s."""
        return self.signals.copy(deep=True)

    def plot(self, directory: str | Path | None = None) -> Figures:
        """Return figures by name.

        Args:
            directory: folder to write PNG and SVG files into, if not None; it is made.
        """
        from stewart_drake.reporting.figures import draw_run

        return drawn(draw_run(self), directory)

    def replay(
        self,
        path: str | Path | None = None,
        *,
        meshcat: "Meshcat | None" = None,
        mechanism: Mechanism | None = None,
        title: str = "replay",
    ) -> "Replay | Path | Meshcat":
        """Show the run in three dimensions: in Meshcat, as a file, or in a notebook.

        Args:
            path: HTML file to write, which plays without a network; its folder is made.
            meshcat: where to play it instead.
            mechanism: the machine, by default the scenario's.
            title: of the page.

        Returns:
            The path, the Meshcat, or without either an object that a notebook shows.
        """
        from stewart_drake.reporting.replay import replay, replay_html

        machine = simulated_machine(self.scenario) if mechanism is None else mechanism
        if meshcat is not None:
            return replay(self.signals, machine, meshcat)
        return _kept(replay_html(self, machine, title), path)


class ComparisonResult(Printed, dict[str, SimulationResult]):
    """Runs of a scenario under several controllers, by controller."""

    def __init__(self, runs: Mapping[str, loop_results.SimulationResult]) -> None:
        super().__init__((name, SimulationResult.of(run)) for name, run in runs.items())

    def __repr__(self) -> str:
        return f"ComparisonResult({', '.join(f'{k}: {run.status}' for k, run in self.items())})"

    @property
    def summary(self) -> dict[str, Any]:
        """Content of `summary.json`."""
        return {"controllers": {name: run.summary for name, run in self.items()}}

    def table(self) -> str:
        """Return a row per controller as text."""
        return comparison_document(self).plain()

    def to_pandas(self) -> pandas.DataFrame:
        """Return a row per controller with the numbers and words of its summary.

        A nested entry is the column `counts.saturated_steps`, an item `peak_error.0`. Scenario,
        versions and warnings are left out.
        """
        rows = {name: dict(_flat(run.summary)) for name, run in self.items()}
        return pandas.DataFrame.from_dict(rows, orient="index").rename_axis("controller")

    def to_xarray(self) -> xarray.Dataset:
        """Return the signals of all runs over `controller` and `time`.

        A run that ended early has NaN afterwards.
        """
        runs = [run.signals.drop_attrs(deep=False) for run in self.values()]
        whole = xarray.concat(runs, "controller", join="outer", combine_attrs="drop")
        return whole.assign_coords(controller=list(self))

    def plot(self, directory: str | Path | None = None) -> Figures:
        """Return figures by name; see `SimulationResult.plot`."""
        from stewart_drake.reporting.figures import draw_comparison

        return drawn(draw_comparison(self), directory)

    def replay(self, directory: str | Path | None = None) -> "dict[str, Replay | Path | Meshcat]":
        """Return the replay of each run by controller.

        Args:
            directory: folder to write them into as NAME.html, if not None; it is made. A single
                run takes a file.
        """
        folder = _replays(directory)
        return {
            name: run.replay(folder and folder / f"{name}.html", title=name)
            for name, run in self.items()
        }

    def save(self, directory: str | Path) -> None:
        """Write NAME.nc of every controller, then summary.json; the directory is made."""
        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        remove_partials(folder)
        for name, run in self.items():
            write_netcdf(folder / f"{name}.nc", run.signals)
        write_json(folder / "summary.json", self.summary)


class ControllerMargin(Printed, loop_margin.ControllerMargin):
    __doc__ = loop_margin.ControllerMargin.__doc__

    @classmethod
    def of(cls, margin: loop_margin.ControllerMargin) -> "ControllerMargin":
        return cls(**vars(margin))

    def __repr__(self) -> str:
        return f"ControllerMargin({loop_verdict(self)!r})"

    def table(self) -> str:
        """Return stability, margins and the growth of prediction errors as text."""
        from stewart_drake.reporting.delay import gains_text

        verdicts = loop_verdict(self), Verdict.of(self)
        given = {"margin": self, "verdicts": verdicts, "gains": gains_text}
        return from_template("margin", milliseconds=milliseconds, **given).plain()


class MechanismCheck(Printed, new_machine.MechanismCheck):
    """Check of a mechanism at home. Printed it is a table."""

    def __repr__(self) -> str:
        return f"MechanismCheck({self.mechanism.name!r}, {self.verdict!r})"

    def table(self) -> str:
        from stewart_drake.reporting.mechanism import document

        return document(self).plain()


class NewMachine(Printed, new_machine.NewMachine):
    """New machine with a first check. Printed it is a table."""

    def __repr__(self) -> str:
        return f"NewMachine({self.check.mechanism.name!r}, {self.verdict!r})"

    def table(self) -> str:
        crossings = [Caution(text).plain() for text in self.crossings]
        check = MechanismCheck(*self.check).table()
        return "\n".join([check, *map(wrap, self.findings), *crossings])


_LEFT_OUT: Final = ("scenario", "versions", "warnings")
"""Entries of a summary that are not figures of the run."""


def _flat(entries: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the numbers and words of nested entries with dotted names."""
    for name, value in entries.items():
        if isinstance(value, list | tuple):
            value = dict(zip(map(str, range(len(value))), value, strict=True))
        if not above and name in _LEFT_OUT:
            continue
        if isinstance(value, Mapping):
            yield from _flat(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


@dataclass(frozen=True, repr=False)
class AnalysisResult(Printed):
    """Result of an analysis or a report. Printed it is text, in a notebook a page.

    Attributes:
        study: all numbers.
        summary: content of `summary.json`.
        document: description of the study.
        made: origin of the page.
        write: writes further files of the study into a folder and returns their names.
    """

    study: Any
    summary: dict[str, Any]
    document: Document
    made: "Provenance"
    write: Callable[[Any, Path], list[str]] | None = None

    def write_files(self, folder: Path | None) -> list[str]:
        """Write the study's further files into a folder and return their names."""
        return [] if folder is None or self.write is None else self.write(self.study, folder)

    @property
    def verdict(self) -> str:
        """The conclusion in a sentence or two."""
        return self.document.verdict

    def __repr__(self) -> str:
        return f"AnalysisResult({self.verdict!r})"

    def _repr_html_(self) -> str:
        from stewart_drake.reporting.page import html

        return _framed(html(self.document, self.made))

    def table(self) -> str:
        return self.document.plain()

    def to_pandas(self) -> dict[str, pandas.DataFrame]:
        """Return the lists of the summary by name, with a row per entry.

        A nested entry is the column `error.rho`.
        """
        entries = {name: one for name, one in self.summary.items() if isinstance(one, list)}
        return {
            name: pandas.json_normalize(rows)
            for name, rows in entries.items()
            if rows and all(isinstance(row, dict) for row in rows)
        }

    def plot(self, directory: str | Path | None = None) -> Figures:
        """Return the figures of the page by name, numbered where one comes again.

        Args:
            directory: folder to write PNG and SVG files into, if not None; it is made.
        """
        counts, shown = Counter[str](), {}
        for one in self.document.all(Picture):
            counts[one.name] += 1
            n = counts[one.name]
            shown[f"{one.name}_{n}" if n > 1 else one.name] = one.drawn
        return drawn(shown, directory)

    def replay(self, directory: str | Path | None = None) -> "dict[str, Replay | Path]":
        """Return the animations of the page by name, empty for a page without.

        Args:
            directory: folder to write them into as NAME.html, if not None; it is made.
        """
        folder, frames = _replays(directory), self.document.all(Frame)
        return {one.name: _kept(one.html, folder, f"{one.name}.html") for one in frames}

    def write_page(self, directory: Path, name: str = PAGE) -> Path:
        """Write the page into a directory and return its path."""
        from stewart_drake.reporting.page import html

        write_whole(directory / name, html(self.document, self.made))
        return directory / name

    def save(self, directory: str | Path) -> Path:
        """Write report.html and summary.json into a directory, which is made; return the page."""
        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        self.write_files(folder)
        write_json(folder / "summary.json", self.summary)
        return self.write_page(folder)


def analysis_result(
    study: Callable[[], Any],
    document: Callable[[Any], Document],
    command: str,
    write: Callable[[Any, Path], list[str]] | None = None,
) -> AnalysisResult:
    """Do a study and describe its result.

    `study` returns the numbers, with a `summary` of plain data. `command` repeats it, as typed.
    """
    from stewart_drake.reporting.page import Provenance

    started = time.perf_counter()
    found = study()
    made = Provenance(command, seconds=time.perf_counter() - started)
    return AnalysisResult(found, found.summary, document(found), made, write)


def _framed(page: str) -> str:
    """Return a page inside another one, where its scripts reach nothing outside."""
    return (
        f'<iframe srcdoc="{escaping.escape(page)}" sandbox="allow-scripts" '
        'style="width: 100%; height: 600px; border: 0"></iframe>'
    )


def _replays(directory: str | Path | None) -> Path | None:
    """Return the folder of several animations; refuse the name of a file."""
    folder = None if directory is None else Path(directory)
    if folder is not None and folder.suffix == ".html":
        raise ConfigError(f"directory: got {folder}; expected a folder, for a file per animation")
    return folder


def _kept(text: str, place: str | Path | None, *name: str) -> Replay | Path:
    """Return an animation, or its path if it has a place, where it is written."""
    if place is None:
        return Replay(text)
    path = Path(place, *name)
    write_asked("directory" if name else "path", path, text)
    return path


def drawn(figures: "Mapping[str, Figure]", directory: str | Path | None) -> Figures:
    """Return figures by name, written into a directory if it is not None."""
    from stewart_drake.reporting.style import write_figures

    if directory is not None:
        Path(directory).mkdir(parents=True, exist_ok=True)
        write_figures(figures, directory)
    return Figures(figures)
