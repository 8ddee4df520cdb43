"""One run of a study: how it ended, and the small file that keeps this.

Files are read back as strictly as a scenario. One says that a run completed only if all that a
completed run has is there; whatever breaks a rule is a ConfigError, never a success.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import ConfigDict, Field, WrapValidator
from pydantic.dataclasses import dataclass

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.jsonio import jsonable, load_json, sealed_json
from stewart_drake.files.yamlio import brief, validate
from stewart_drake.loop.bulk import Ending, run_in_bulk
from stewart_drake.scenario.config import Scenario

_MAX_BYTES: Final = 1_000_000
_EXPECTED: Final = "the file of one run of a study"
_STRICT: Final = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


def _or_nan(value: Any, check: Any) -> float:
    missing = value is None or (isinstance(value, float) and not math.isfinite(value))
    return math.nan if missing else float(check(value))


_Number = Annotated[float, Field(ge=0), WrapValidator(_or_nan)]
"""Not negative; null, and what is not finite, is NaN."""


@dataclass(config=_STRICT)
class Outcome:
    """How a run ended.

    Attributes:
        status: as of a simulation; `not_assembled` where drawn parts do not fit together, `refused`
            where the scenario cannot be prepared with what was drawn.
        reason: why it failed, or nothing.
        leg: that reached its end, or None.
        time: s, when it failed, else NaN.
        error: E_ac in % s, NaN for a run that did not complete.
        peak_torque: N m, as commanded, NaN where nothing ran.
        tuner_fallbacks: samples at which a tuner passed its network over.
        loop: what ran it, see `loop.bulk.Ending`; nothing where nothing ran.
    """

    status: Literal["completed", "left_workspace", "solver_failed", "not_assembled", "refused"]
    reason: str = ""
    leg: Annotated[int, Field(ge=1, le=6)] | None = None
    time: _Number = math.nan
    error: _Number = math.nan
    peak_torque: _Number = math.nan
    tuner_fallbacks: Annotated[int, Field(ge=0)] = 0
    loop: str = ""


@dataclass(config=_STRICT)
class _File:
    draw: dict[str, Any]
    outcome: Outcome


def outcome_of(ending: Ending) -> Outcome:
    """How a run ended."""
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


def loops_of(outcomes: Iterable[Outcome]) -> dict[str, int]:
    """Number of runs by what ran them, the most frequent first."""
    return dict(Counter(one.loop for one in outcomes if one.loop).most_common())


def run_file(outcome: Outcome, draw: dict[str, Any] | None = None) -> bytes:
    """The file of a run, JSON: what was drawn for it, and how it ended."""
    data = {"draw": draw or {}, "outcome": dataclasses.asdict(outcome)}
    return sealed_json(data)


def run_scenario(scenario: Scenario) -> bytes:
    """Run a scenario as it stands: the file of the run.

    Raises:
        As `run_in_bulk`.
    """
    return run_file(outcome_of(run_in_bulk(scenario)))


def read_outcome(path: Path) -> Outcome:
    """How a run ended, from its file.

    Raises:
        ConfigError: the file is damaged; one line, with the field.
    """
    one = validate(_File, load_json(path, _MAX_BYTES, _EXPECTED, sealed=True), str(path)).outcome
    done = one.status == "completed"
    rules = {
        "error": (math.isnan(one.error) != done, "a number" if done else "null"),
        "time": (math.isnan(one.time) == done, "null" if done else "a number"),
        "reason": ((one.reason == "") == done, "no reason" if done else "a reason"),
        "leg": (one.leg is None or not done, "null"),
    }
    for name, (kept, wanted) in rules.items():
        if not kept:
            got = brief(jsonable(getattr(one, name)))
            raise ConfigError(
                f"{path}: {name}: got {got}; expected {wanted} of a run with status {one.status}"
            )
    return one
