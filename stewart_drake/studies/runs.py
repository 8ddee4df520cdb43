"""One run of a study: how it ended, and the small JSON file that keeps this."""

import dataclasses
import math
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Final, Literal, TypeVar

from pydantic import Field, WrapValidator
from pydantic.dataclasses import dataclass

from stewart_drake.files.jsonio import load_json, sealed_json
from stewart_drake.files.yamlio import validate
from stewart_drake.loop.bulk import Ending, run_in_bulk
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.field_types import STRICT
from stewart_drake.studies.jobs import Progress, run_jobs

_Kind = TypeVar("_Kind")
_MAX_BYTES: Final = 1_000_000


def _or_nan(value: Any, check: Any) -> float:
    missing = value is None or (isinstance(value, float) and not math.isfinite(value))
    return math.nan if missing else float(check(value))


_Number = Annotated[float, Field(ge=0), WrapValidator(_or_nan)]
"""Number that is not negative; null, infinity and NaN become NaN."""


@dataclass(config=STRICT)
class Outcome:
    # as of a simulation; `not_assembled` if drawn parts do not fit together, `refused` if the
    # scenario with the drawn values cannot be prepared
    status: Literal["completed", "left_workspace", "solver_failed", "not_assembled", "refused"]
    reason: str = ""  # why it failed, or empty
    leg: Annotated[int, Field(ge=1, le=6)] | None = None  # that reached its end, or None
    time: _Number = math.nan  # s, when it failed, else NaN
    error: _Number = math.nan  # E_ac in % s, NaN for a run that did not complete
    peak_torque: _Number = math.nan  # N m, as commanded, NaN without a run
    # number of samples at which a tuner ignored its network
    tuner_fallbacks: Annotated[int, Field(ge=0)] = 0
    loop: str = ""  # what ran it, see `loop.bulk.Ending`; empty without a run


@dataclass(config=STRICT)
class _File:
    draw: dict[str, Any]
    outcome: Outcome


def outcome_of(ending: Ending) -> Outcome:
    stopped = ending.stopped
    ended: dict[str, Any] = {}
    if stopped is not None:
        ended = {"reason": stopped.reason, "leg": stopped.leg, "time": stopped.time}
    return Outcome(
        status=ending.status,  # type: ignore[arg-type]  # never `interrupted`, which is checked
        error=ending.figures.accumulated_error,
        peak_torque=ending.figures.peak_torque,
        tuner_fallbacks=ending.counts["tuner_fallbacks"],
        loop=ending.loop,
        **ended,
    )


def run_file(outcome: Outcome, draw: dict[str, Any] | None = None) -> bytes:
    return sealed_json({"draw": draw or {}, "outcome": dataclasses.asdict(outcome)})


def run_scenario(scenario: Scenario) -> bytes:
    return run_file(outcome_of(run_in_bulk(scenario)))


def run_scenarios(
    scenarios: Mapping[str, Scenario],
    progress: Progress | None = None,
    *,
    directory: Path | None = None,
    settings: Mapping[str, Any] | None = None,
) -> tuple[dict[str, Outcome], bool]:
    """Return outcomes of runs on all cores, as far as they finished, and whether Ctrl-C came.

    A directory keeps the runs of the same `settings`.
    """
    interrupted = False
    with nullcontext(directory) if directory else TemporaryDirectory() as folder:
        try:
            jobs = {key: (scenario,) for key, scenario in scenarios.items()}
            run_jobs(
                jobs,
                run_scenario,
                folder,
                settings=settings or {},
                read=read_outcome,
                progress=progress,
            )
        except KeyboardInterrupt:
            interrupted = True
        paths = {key: Path(folder) / f"{key}.json" for key in scenarios}
        found = {key: read_outcome(path) for key, path in paths.items() if path.exists()}
    return found, interrupted


def read_outcome(path: Path) -> Outcome:
    return read_kept(_File, "the file of one run of a study", path).outcome


def read_kept(kind: type[_Kind], expected: str, path: Path) -> _Kind:
    """Read a dataclass from a file of `sealed_json`; `expected` describes the file."""
    return validate(kind, load_json(path, _MAX_BYTES, expected, sealed=True), str(path))
