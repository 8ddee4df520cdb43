"""Form for the measurements of a machine, a page on this computer with a drawing that follows."""

import json
import threading
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, Literal, get_args, get_origin

from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.reporting.local_page import LocalServer
from stewart_drake.reporting.mechanism import mechanism_figure
from stewart_drake.reporting.page import source
from stewart_drake.studies.new_machine import machine_text, proposed
from stewart_drake.studies.options import Option
from stewart_drake.studies.study_options import Measurements

_MASSES: Final = ("plate_mass", "crank_mass", "rod_mass")
_ANY_MASS: Final = 1e-3
"""Mass of a part in a drawing before the mass is given, kg."""
_PATIENCE: Final = 10.0
"""Longest wait for a browser that fetches the report, s."""
_EXAMPLE: Final = {
    **{"base_radius": "200 mm", "shaft_distance": "130 mm", "plate_radius": "110 mm"},
    **{"joint_distance": "60 mm", "crank": "50 mm", "rod": "260 mm"},
    **{"plate_mass": "2.5 kg", "crank_mass": "60 g", "rod_mass": "50 g", "torque_limit": "6 N m"},
}
"""Measurements of a machine that is shown until the own lengths are complete."""


Entries = dict[str, str]
"""Texts of a form by the name of the measurement, without those that are missing."""


def drawing(entries: Entries) -> str:
    """Return the drawing as a data URI; masses that are missing do not matter."""
    masses = dict.fromkeys(_MASSES, str(_ANY_MASS))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "machine.yaml"
        path.write_text(machine_text(Measurements(**entries | masses), "machine"))
        try:
            return source(mechanism_figure(load_mechanism(path)))
        except UnreachablePoseError as error:
            raise ConfigError(f"rod: {error}") from None


def answer(entries: Entries) -> dict[str, Any]:
    """Return what the page shows: `drawing` or null, `field` and `problem` or null.

    The drawing is an `example` while a length is missing.
    """
    example = not entries.keys() >= _EXAMPLE.keys() - {*_MASSES, "torque_limit"}
    found: dict[str, Any] = {"drawing": None, "field": None, "problem": None, "example": example}
    try:
        found["drawing"] = drawing(_EXAMPLE if example else entries)
        measurements = Measurements(**entries)
        with TemporaryDirectory() as folder:
            proposed(measurements, "machine", Path(folder) / "machine.yaml")
    except ConfigError as error:
        name, _, words = str(error).partition(": ")
        known = name in Measurements.model_fields
        found["field"], found["problem"] = (name, words) if known else (None, str(error))
    return found


def read_entries(data: bytes) -> Entries | None:
    """Return the entries of a browser's request, or None for anything else."""
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):  # thousands of brackets
        return None
    known = isinstance(found, dict) and found.keys() <= Measurements.model_fields.keys()
    if not known or not all(isinstance(text, str) for text in found.values()):
        return None
    return {name: text.strip() for name, text in found.items() if text.strip()}


class MachineForm:
    """The form, served until it is closed, as by `contextlib.closing`.

    It begins with the `given` measurements, by name.
    """

    def __init__(self, given: Mapping[str, Any], title: str) -> None:
        self._entries: Entries = {}
        self._drawing = threading.Lock()  # Matplotlib draws in one thread at a time
        self._asked, self._ready, self._fetched = (threading.Event() for _ in range(3))
        self._report = ""
        fields = [_field(one, given.get(one.name)) for one in Measurements.described()]
        values = {"title": title, "fields": fields}
        self._server = LocalServer(
            "machine_form.html.j2", values, {"/report": self._report_page}, self._take
        )
        self.url = self._server.url

    def _take(self, path: str, data: bytes) -> str | None:
        """Return `answer` as JSON; take complete entries that are to be written, once."""
        entries = read_entries(data)
        if entries is None or path not in ("/check", "/write"):
            return None
        with self._drawing:
            if self._asked.is_set():  # the report is being drawn
                return None
            found = answer(entries)
            if path == "/write" and found["problem"] is None:
                self._entries = entries
                self._asked.set()
        return json.dumps(found)

    def wait(self) -> Measurements:
        while not self._asked.wait(0.2):  # short, so that Ctrl-C ends it
            pass
        return Measurements(**self._entries)

    def _report_page(self) -> str:
        """Wait for the page that follows the form."""
        self._ready.wait()
        self._fetched.set()
        return self._report

    def show(self, page: str) -> None:
        """Show a page in place of the form, and wait until a browser has fetched it."""
        self._report = page
        self._ready.set()
        self._fetched.wait(_PATIENCE)

    def close(self) -> None:
        self._ready.set()
        self._server.shutdown()
        self._server.server_close()


def _field(one: Option, given: Any) -> dict[str, Any]:
    """Return an input of the form: name, label, example, value and choices."""
    choices = ["true", "false"] if one.annotation is bool else []
    if get_origin(one.annotation) is Literal:
        choices = list(get_args(one.annotation))
    default = "" if one.required or one.default is None else one.default
    if one.unit and default != "":
        default = f"{default:g} {one.unit}"
    value = default if given is None else given
    text = str(value).lower() if isinstance(value, bool) else f"{value}"
    label = one.help.removesuffix(".").removesuffix(f", {one.unit}")
    return {
        "name": one.name,
        "label": label,
        "example": _EXAMPLE.get(one.name, ""),
        "value": text,
        "choices": choices,
        "required": one.required,
    }
