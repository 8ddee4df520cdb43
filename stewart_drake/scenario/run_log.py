"""Logs that are written while a run goes on: MCAP, CSV, and JSON over UDP; and their reading.

A log has a channel for each signal of `scenario.signals`, with a field for each component. In MCAP
the messages are JSON with a JSON schema, as Foxglove, rerun and PlotJuggler read them, and the
metadata record `stewart_drake` has the scenario. A CSV file has one column per component, and its
scenario in a file of the same name that ends in .yaml. A killed run leaves a readable file.

With position servos a log ends with SERVO_SIGNALS, for `identification.servo_logs`.
"""

import contextlib
import copy
import csv
import fcntl
import json
import logging
import math
import os
import queue
import re
import socket
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import xarray as xr

from stewart_drake.files.arrayio import load_netcdf
from stewart_drake.files.errors import ConfigError, optional
from stewart_drake.files.fileio import write_whole
from stewart_drake.files.versions import versions
from stewart_drake.files.yamlio import parse_yaml, validate
from stewart_drake.scenario.config import ESTIMATED, ControllerConfig, Scenario
from stewart_drake.scenario.loading import scenario_yaml
from stewart_drake.scenario.signals import (
    NUM_LEGS,
    SERVO_SIGNALS,
    Signal,
    recorded_signals,
    run_signals,
)
from stewart_drake.types import Array

EXPECTED: Final = "signals.nc, a log (.mcap, .csv) or the folder of a run"
_METADATA: Final = "stewart_drake"
_MAGIC: Final = b"\x89MCAP0\r\n"
"""First and last bytes of a whole MCAP file."""
_CHUNK: Final = 1 << 16
"""Bytes of JSON after which an MCAP file is written on."""
_QUEUE: Final = 4096
"""Largest number of rows that wait for a slow disk."""
_log: Final = logging.getLogger("stewart_drake")
_ENCODER: Final = re.compile(r"measurement_A\d")


def logged(scenario: Scenario, servos: bool = True) -> list[Signal]:
    """Return the signals of a log, with setpoints and cranks of position servos if `servos`."""
    servos = servos and scenario.actuator.kind == "position_servo"
    return [*recorded_signals(scenario.sensor.samples), *(SERVO_SIGNALS if servos else ())]


class RunLog(Protocol):
    def write(self, time: float, values: Mapping[str, Array]) -> None:
        """Add the values of channels at a time in s; others have none then."""

    def close(self) -> None:
        """Complete the log."""


def kind_of_log(path: Path, name: str = "log") -> Callable[[Path, Scenario, bool], RunLog]:
    """Return the class of a log, by the suffix of its file; `name` opens an error."""
    if path.suffix == ".csv":
        return CsvLog
    if path.suffix != ".mcap":
        raise ConfigError(f"{name}: got {str(path)!r}; expected a file that ends in .mcap or .csv")
    _mcap("mcap.writer")
    return McapLog


def open_log(path: Path, scenario: Scenario, servos: bool = True) -> RunLog:
    """Open a log for writing, in a file that ends in .mcap or .csv; `servos` as of `logged`."""
    try:
        return kind_of_log(path)(path, scenario, servos)
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be written ({error.strerror}); expected a file"
        ) from None


def _emptied(path: Path) -> int:
    """Return the descriptor of an empty file, which others cannot open here until it is closed."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.ftruncate(descriptor, 0)
    except OSError as error:
        os.close(descriptor)
        if isinstance(error, BlockingIOError):
            problem = "another log is being written there; expected another name"
            raise ConfigError(f"{path}: {problem}") from None
        raise
    return descriptor


def _members(fields: Iterable[str], values: Array) -> dict[str, float]:
    """Return the finite components by field; JSON has no NaN."""
    pairs = zip(fields, np.atleast_1d(values).tolist(), strict=True)
    return {field: value for field, value in pairs if math.isfinite(value)}


@contextlib.contextmanager
def _naming(path: Path | None) -> Iterator[None]:
    """Name a file in an error of writing, as on a full disk, which names none."""
    try:
        yield
    except OSError as error:
        error.filename = None if path is None else str(path)
        raise


class McapLog:
    """An MCAP file, which is replaced, with one topic for each signal."""

    def __init__(self, path: Path, scenario: Scenario, servos: bool = True) -> None:
        writer, self._path = _mcap("mcap.writer"), path
        self._file = os.fdopen(_emptied(path), "wb")
        self._writer = writer.Writer(self._file, chunk_size=_CHUNK)
        self._writer.start(profile="", library=f"stewart_drake {versions()['stewart-drake']}")
        about = {"scenario": scenario_yaml(scenario), "versions": json.dumps(versions())}
        self._writer.add_metadata(_METADATA, about)
        self._channels: dict[str, tuple[int, tuple[str, ...]]] = {}
        for channel in logged(scenario, servos):
            properties = {"time": {"type": "number", "description": "s"}}
            for field, head in zip(channel.fields, channel.heads, strict=True):
                unit = head.partition("[")[2].removesuffix("]")
                properties[field] = {"type": "number", "description": unit}
            schema = {
                "title": channel.name,
                "description": channel.long_name,
                "type": "object",
                "properties": properties,
            }
            number = self._writer.register_schema(
                f"stewart_drake.{channel.name}", "jsonschema", json.dumps(schema).encode()
            )
            topic = self._writer.register_channel(f"/{channel.name}", "json", number)
            self._channels[channel.name] = topic, channel.fields
        self._row = 0

    def write(self, time: float, values: Mapping[str, Array]) -> None:
        at = round(time * 1e9)
        for name, components in values.items():
            topic, fields = self._channels[name]
            data = json.dumps({"time": time} | _members(fields, components)).encode()
            with _naming(self._path):
                self._writer.add_message(topic, at, data, at, self._row)
        self._row += 1

    def close(self) -> None:
        with _naming(self._path), self._file:
            self._writer.finish()


class CsvFile:
    """A CSV file of rows of numbers, which read back exactly; empty cells are not finite.

    Each row is written whole or not at all. A file is replaced; without a path it is a temporary
    one without a name. `heads` are the cells of the first line, `descriptor` is that of the file.
    """

    def __init__(self, path: Path | None, heads: Iterable[str]) -> None:
        if path is None:
            with tempfile.TemporaryFile() as file:
                self.descriptor = os.dup(file.fileno())
        else:
            self.descriptor = _emptied(path)
        self._whole, self._path = 0, path
        self._add(heads)

    def write(self, row: Iterable[float]) -> None:
        self._add(repr(x) if math.isfinite(x) else "" for x in row)

    def close(self) -> None:
        os.close(self.descriptor)

    def _add(self, cells: Iterable[str]) -> None:
        data = (",".join(cells) + "\n").encode("ascii")
        try:
            with _naming(self._path):
                done = 0
                while done < len(data):
                    done += os.write(self.descriptor, data[done:])
        except OSError:
            os.ftruncate(self.descriptor, self._whole)
            raise
        self._whole += done


class CsvLog:
    """A CSV file, which is replaced, with a line per instant; its scenario is in a .yaml."""

    def __init__(self, path: Path, scenario: Scenario, servos: bool = True) -> None:
        self._channels, companion = logged(scenario, servos), path.with_suffix(".yaml")
        if companion.exists() and not path.exists():
            raise ConfigError(
                f"{path}: its scenario would replace {companion.name}, which is of no log; "
                "expected another name"
            )
        self._file = CsvFile(path, csv_heads(self._channels))
        write_whole(companion, scenario_yaml(scenario))

    def write(self, time: float, values: Mapping[str, Array]) -> None:
        numbers = [time]
        for channel in self._channels:
            missing = [math.nan] * channel.size
            numbers += np.atleast_1d(values.get(channel.name, missing)).tolist()
        self._file.write(numbers)

    def close(self) -> None:
        self._file.close()


def csv_heads(channels: Iterable[Signal]) -> list[str]:
    """Return the first line of a CSV log."""
    return ["time[s]", *(head for channel in channels for head in channel.heads)]


class UdpMirror:
    """JSON over UDP, one datagram per instant, for PlotJuggler's UDP server."""

    def __init__(self, address: tuple[str, int], scenario: Scenario) -> None:
        self._fields = {one.name: one.fields for one in logged(scenario)}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._address = address

    def write(self, time: float, values: Mapping[str, Array]) -> None:
        row: dict[str, Any] = {"timestamp": time}
        for name, components in values.items():
            row[name] = _members(self._fields[name], components)
        with contextlib.suppress(OSError):  # nothing listens, or the network is full
            self._socket.sendto(json.dumps(row).encode(), self._address)

    def close(self) -> None:
        self._socket.close()


class Background:
    """A log or file that a thread writes, for a loop in real time; an error is reported once."""

    def __init__(self, log: RunLog | CsvFile, name: str, say: Callable[[str], None]) -> None:
        self._log: Any = log
        self._name, self._say, self._failed = name, say, False
        self._rows: queue.Queue[tuple[Any, ...] | None] = queue.Queue(_QUEUE)
        self._thread = threading.Thread(target=self._work, daemon=True)

    def write(self, *row: Any) -> None:
        """Add what the log's `write` takes, without waiting."""
        if not self._thread.is_alive():
            # Started here it has the priority of the loop, which waits for the GIL.
            self._thread.start()
        try:
            self._rows.put_nowait(copy.deepcopy(row))
        except queue.Full:
            self._fail("the disk is too slow")

    def close(self) -> None:
        """Write the waiting rows and close the log."""
        if self._thread.is_alive():
            self._rows.put(None)
            self._thread.join()
        with self._reported():
            self._log.close()

    def _work(self) -> None:
        while (row := self._rows.get()) is not None:
            if not self._failed:
                with self._reported():
                    self._log.write(*row)

    @contextlib.contextmanager
    def _reported(self) -> Any:
        try:
            yield
        except OSError as error:
            self._fail(str(error.strerror))

    def _fail(self, reason: str) -> None:
        if not self._failed:
            self._failed = True
            self._say(f"{self._name}: {reason}; the run goes on, the file ends here")


# ---------------------------------------------------------------- reading


def dataset_of(
    times: Array, values: Mapping[str, Array], scenario: str | None, samples: int | None
) -> xr.Dataset:
    """Return signals (n, size) by name as a Dataset over `time` (n,) in s, with the error.

    `scenario` is YAML; `samples` are encoder readings per period, None for a measured state.
    """
    values = dict(values)
    if "pose" in values and "reference" in values:
        values["error"] = values["pose"] - values["reference"]
    variables, signals = dict[str, Any](), run_signals(samples)
    for name, signal in signals.items():
        if name in values:
            about = {"units": signal.unit, "long_name": signal.long_name}
            if dimension := signal.quantity.dimension:
                variables[name] = ("time", dimension.name), values[name], about
            else:
                variables[name] = "time", values[name][:, 0], about
    coordinates: dict[str, Any] = {
        one.name: (one.name, list(one.labels), {"long_name": one.long_name})
        for signal in signals.values()
        if (one := signal.quantity.dimension)
    }
    coordinates["time"] = ("time", times, {"units": "s", "long_name": "time"})
    attributes = {
        "title": "closed loop of a rotary Stewart platform with delayed torques",
        "versions": json.dumps(versions()),
    } | ({} if scenario is None else {"scenario": scenario})
    return xr.Dataset(variables, coordinates, attributes)


def is_run(path: Path) -> bool:
    """Return whether a file or folder is of a run, not the CSV log of a real machine."""
    if path.suffix != ".csv" or not path.is_file():
        return path.suffix in (".nc", ".mcap") or path.is_dir()
    with contextlib.suppress(OSError, UnicodeDecodeError), open(path, encoding="utf-8") as file:
        return file.readline(1 << 16).startswith("time[s],pose_roll[rad]")
    return False


def read_log(path: str | Path) -> xr.Dataset:
    """Return the signals of a run as `SimulationResult.signals` has them.

    Args:
        path: signals.nc, a log (.mcap or .csv), or the folder of a run, whose signals.nc is taken
            before its logs. A log without an end, of a run that was killed, is read up to there;
            the package's logger warns of it.

    Raises:
        ConfigError: no such file, or not of a run; one line.
    """
    path = Path(path)
    if path.is_dir():
        found = [*path.glob("signals.nc"), *sorted(path.glob("*.mcap")), *path.glob("log.csv")]
        if not found:
            raise ConfigError(f"{path}: has no signals.nc, .mcap or log.csv; expected {EXPECTED}")
        return read_log(found[0])
    if not path.is_file():  # opening a pipe would wait for ever
        problem = "is not a file" if path.exists() else "no such file"
        raise ConfigError(f"{path}: {problem}; expected {EXPECTED}")
    if path.suffix == ".nc":
        return load_netcdf(path, EXPECTED)
    if path.suffix not in (".mcap", ".csv"):
        raise ConfigError(f"{path}: got a file of another kind; expected {EXPECTED}")
    try:
        return _read_csv(path) if path.suffix == ".csv" else _read_mcap(path)
    except (OSError, ValueError, KeyError, csv.Error) as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise ConfigError(f"{path}: cannot be read ({reason}); expected {EXPECTED}") from None


def with_new_names(scenario: dict[str, Any]) -> dict[str, Any]:
    """Return the data of a scenario that the program wrote, 0.2 included, under the new names."""
    given = scenario.get("controller")
    if not isinstance(given, dict):
        return scenario
    controller = {ControllerConfig.renamed.get(name, name): value for name, value in given.items()}
    if "estimator" in given:
        asked = {name: given.get(f"estimate_{name}", False) for name in ("coulomb", "offsets")}
        chosen = [*ESTIMATED, *(name for name in asked if asked[name])]
        controller["estimate"] = chosen if given["estimator"] == "parameters" else []
    return scenario | {"controller": controller}


def scenario_of(signals: xr.Dataset, path: Path) -> Scenario:
    """Return the scenario of a log; `path` is for messages."""
    text = signals.attrs.get("scenario")
    if text is None:
        raise ConfigError(
            f"{path}: has no scenario; expected it in {path.with_suffix('.yaml').name} or "
            "summary.json in the same folder"
        )
    place = f"{path}: scenario"
    return validate(Scenario, with_new_names(parse_yaml(text, place)), place)


def _read_mcap(path: Path) -> xr.Dataset:
    records = _mcap("mcap.records")
    topics: dict[int, str] = {}
    times: dict[int, float] = {}
    messages: dict[str, dict[int, dict[str, float]]] = {}
    scenario = None
    with open(path, "rb") as file:
        reader = _mcap("mcap.stream_reader").StreamReader(file, validate_crcs=True)
        try:
            for record in reader.records:
                if isinstance(record, records.Metadata) and record.name == _METADATA:
                    scenario = record.metadata["scenario"]
                elif isinstance(record, records.Channel):
                    topics[record.id] = record.topic.removeprefix("/")
                elif isinstance(record, records.Message):
                    found = json.loads(record.data)
                    times[record.sequence] = float(found["time"])
                    messages.setdefault(topics[record.channel_id], {})[record.sequence] = found
        except Exception:  # of the decompressor too
            if not times:
                raise ValueError("no MCAP file, or one cut before its messages") from None
            file.seek(-len(_MAGIC), os.SEEK_END)
            if file.read() == _MAGIC:  # it was not cut
                raise ValueError(f"damaged after t = {max(times.values()):g} s") from None
            _warn_of_end(path, max(times.values()))
    if not times:
        raise ValueError("no messages")
    if scenario is None:
        raise ValueError("no metadata of stewart_drake")
    sensor = parse_yaml(scenario, f"{path}: scenario").get("sensor", {})
    samples = int(sensor.get("samples", 1)) if sensor.get("kind") == "encoders" else None
    values, order = {}, sorted(times)
    for channel in recorded_signals(samples):
        if found := messages.get(channel.name):
            rows = (found.get(row, {}) for row in order)
            fields = channel.fields
            numbers = [[row.get(field, math.nan) for field in fields] for row in rows]
            values[channel.name] = np.array(numbers)
    return dataset_of(np.array([times[row] for row in order]), values, scenario, samples)


def _read_csv(path: Path) -> xr.Dataset:
    with open(path, encoding="utf-8", newline="") as file:
        lines = csv.reader(file)
        heads, rows = next(lines, []), [*lines]
    encoders = sum(bool(_ENCODER.match(head)) for head in heads)
    samples = encoders // NUM_LEGS or None
    channels = recorded_signals(samples)
    expected = csv_heads(channels)
    if heads[: len(expected)] != expected:
        wrong = next((a for a, b in zip(heads, expected, strict=False) if a != b), "")
        raise ValueError(f"column {wrong!r}, which a log of a run does not have there")
    if cut := bool(rows) and len(rows[-1]) < len(heads):
        del rows[-1]  # of a run that was killed
    for number, row in enumerate(rows, 2):
        if len(row) != len(heads):
            raise ValueError(f"line {number} has {len(row)} cells in place of {len(heads)}")
    if not rows:
        raise ValueError("no rows")
    table = np.array([[float(cell.strip() or "nan") for cell in row] for row in rows])
    if cut:
        _warn_of_end(path, table[-1, 0])
    widths = [channel.size for channel in channels]
    parts = np.split(table[:, 1 : len(expected)], np.cumsum(widths)[:-1], axis=1)
    values = {channel.name: part for channel, part in zip(channels, parts, strict=True)}
    return dataset_of(table[:, 0], values, _scenario_near(path), samples)


def _warn_of_end(path: Path, time: float) -> None:
    _log.warning("%s: cut off, as of a killed run; read up to t = %g s", path, time)


def _scenario_near(path: Path) -> str | None:
    """Return the scenario of a CSV log as YAML: from NAME.yaml or summary.json."""
    sidecar, summary = path.with_suffix(".yaml"), path.parent / "summary.json"
    if sidecar.exists():
        return sidecar.read_text("utf-8")
    if summary.exists():
        found = json.loads(summary.read_text("utf-8")).get("scenario")
        return None if found is None else json.dumps(found)
    return None


def _mcap(module: str) -> Any:
    needed = "expected pip install 'stewart_drake[log]', or a .csv file"
    return optional(module, f".mcap: needs the package mcap; {needed}")
