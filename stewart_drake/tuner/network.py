"""The paper's tuner: a network maps densities to (w_Q, w_R), in plain numpy.

Densities, equation (45), compare a signal with its own recent mean. With w_in + 1 = 31 samples in
the window and n of them known,

    magnitude (bounded):   rho(k) = |eps(k)| / mean |eps(i)|,
    signed (as printed):   rho(k) = eps(k) / mean eps(i),         i = k - w_in, ..., k.

A sample is unknown before the first one and where it is not finite (a missed measurement). The mean
is over the known ones, so that a window that is not full has a value too. Where eps(k) is unknown,
or only zeros are known, rho(k) = 1.

The mean of n magnitudes is at least |eps(k)| / n, hence 0 <= rho <= n <= 31. The signed mean passes
through zero while eps(k) does not, so that (45) as printed is unbounded; it is cut at 1e6,
with the sign of eps(k) where the mean is exactly zero.

The network is

    y = W2 sigmoid(W1 (rho - input_mean) / input_scale + b1) + b2,

with rho the densities or the features `health`, by the name in its file.

A network is one JSON file, read as strictly as a scenario.
"""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pydantic.dataclasses
from scipy.special import expit

from stewart_drake.files.arguments import fixed, one_of
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import write_whole
from stewart_drake.files.jsonio import load_json
from stewart_drake.files.resources import resolve
from stewart_drake.files.yamlio import brief, validate
from stewart_drake.scenario.field_types import STRICT
from stewart_drake.scenario.signals import TUNER_INPUTS, WEIGHTS
from stewart_drake.types import Array, ArrayLike

Kind = Literal["magnitude", "signed"]

WINDOW: Final = 31
"""w_in + 1 samples."""
NUM_INPUTS: Final = len(TUNER_INPUTS)
"""12 state errors (pose, rates) and 6 torques."""
DEFAULT: Final = "tuner"
NUM_OUTPUTS: Final = len(WEIGHTS)

MAX_BYTES: Final = 10_000_000
EXPECTED: Final = "the JSON file of one network"


@dataclasses.dataclass(frozen=True, eq=False)
class Network:
    """A trained network; the paper's has h = 10 hidden neurons."""

    input_mean: Array  # (18,) of the training densities
    input_scale: Array  # (18,) their spread, above zero
    W1: Array  # (h, 18) into the hidden layer, with the sigmoid as activation
    b1: Array  # (h,) bias there
    W2: Array  # (2, h) into the output layer, which is linear
    b2: Array  # (2,) bias there
    bounds: Array  # (2, 2) lower, then upper bound of (w_Q, w_R), to which its users clip
    # of the output layer, (w_Q, w_R) or their natural logarithms
    output: Literal["weights", "log_weights"] = "weights"
    density: Kind = "magnitude"  # of the training
    card: Mapping[str, Any] = field(default_factory=dict)  # data, seed, versions, errors; for JSON
    # of the input, those of `tuner.network` or `tuner.source`
    features: Literal["densities", "health"] = "densities"
    # (2,) w_Q and w_R at the first sample, and to return to, or None for the controller's; a
    # network with a start moves along w_Q / w_R, see `tuner.source`
    start: Array | None = None

    def __post_init__(self) -> None:
        hidden = np.shape(self.b1)[0] if np.ndim(self.b1) == 1 else 0
        shapes = {
            "input_mean": (NUM_INPUTS,),
            "input_scale": (NUM_INPUTS,),
            "b1": (max(1, hidden),),
            "W1": (max(1, hidden), NUM_INPUTS),
            "W2": (NUM_OUTPUTS, max(1, hidden)),
            "b2": (NUM_OUTPUTS,),
            "bounds": (2, NUM_OUTPUTS),
        }
        for name, shape in shapes.items():
            object.__setattr__(self, name, fixed(name, getattr(self, name), shape))
        if not np.all(self.input_scale > 0):
            raise ConfigError(
                f"input_scale: got {self.input_scale.min()!r}; expected numbers above 0"
            )
        if not np.all((self.bounds[0] > 0) & (self.bounds[1] > self.bounds[0])):
            raise ConfigError(
                f"bounds: got {brief(self.bounds.tolist())}; expected [lower, upper] of (w_Q, w_R) "
                "with 0 < lower < upper"
            )
        if self.start is not None:
            object.__setattr__(self, "start", fixed("start", self.start, (NUM_OUTPUTS,)))
            if not np.all((self.start >= self.bounds[0]) & (self.start <= self.bounds[1])):
                raise ConfigError(
                    f"start: got {brief(self.start.tolist())}; expected (w_Q, w_R) within bounds"
                )
        one_of("output", self.output, ("weights", "log_weights"))
        one_of("density", self.density, ("magnitude", "signed"))
        one_of("features", self.features, ("densities", "health"))

    @property
    def hidden(self) -> int:
        return len(self.b1)

    def __call__(self, densities: ArrayLike) -> Array:
        """Raw weights (2,) or (N, 2) of densities (18,) or (N, 18), neither clipped nor checked."""
        with np.errstate(over="ignore", invalid="ignore"):
            inputs = (np.asarray(densities, dtype=np.float64) - self.input_mean) / self.input_scale
            outputs = expit(inputs @ self.W1.T + self.b1) @ self.W2.T + self.b2
            return outputs if self.output == "weights" else np.exp(outputs)


# --------------------------------------------------------------------- the file


@pydantic.dataclasses.dataclass(config=STRICT)
class _File:
    """The file's keys; `features` and `start` may be missing."""

    input_mean: list[float]
    input_scale: list[float]
    W1: list[list[float]]
    b1: list[float]
    W2: list[list[float]]
    b2: list[float]
    bounds: list[list[float]]
    output: Literal["weights", "log_weights"]
    density: Literal["magnitude", "signed"]
    card: dict[str, Any]
    features: Literal["densities", "health"] = "densities"
    start: list[float] | None = None


def save_network(network: Network, path: str | Path) -> None:
    """Write one JSON file, whole or not; what is loaded from it is equal to the last bit."""
    data = {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in vars(network).items()
    }
    try:
        text = json.dumps(data | {"card": dict(network.card)}, indent=2, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"card: {error}; expected plain JSON values, null for NaN") from None
    write_whole(Path(path), text + "\n")


def load_network(name_or_path: str | Path) -> Network:
    """Read a network by its name in `models/weights/` or as a JSON file with its fields."""
    path = resolve("weights", name_or_path)
    file = validate(_File, load_json(path, MAX_BYTES, EXPECTED), str(path))
    try:
        return Network(**vars(file))
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
