"""The tuner's network in torch, and its Levenberg-Marquardt training.

theta holds W1 (h, 18), b1 (h,), W2 (2, h), b2 (2,) one after the other, and

    f(theta, u) = W2 sigmoid(W1 u + b1) + b2,    minimise 1/2 sum |f(theta, u_i) - y_i|^2.

Levenberg and Marquardt solve (J'J + lambda D^2) step = -J' r; MINPACK does it through QR.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from stewart_drake.files.errors import ConfigError
from stewart_drake.tuner.network import NUM_OUTPUTS
from stewart_drake.types import Array


@dataclass(frozen=True)
class Fit:
    """A trained parameter vector.

    Attributes:
        theta: the parameters.
        curve: (iterations, 2) root mean square errors of the training and the test rows, from the
            start on.
        evaluations: of the residuals.
        converged: whether MINPACK stopped by itself.
    """

    theta: Array
    curve: Array
    evaluations: int
    converged: bool


def require_torch() -> Any:
    """The module torch, with one thread.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import torch
    except ImportError:
        raise ConfigError(
            "tune train: needs torch; install it with pip install 'stewart-drake[train]'"
        ) from None
    torch.set_num_threads(1)
    return torch


def unpack(theta: Any, inputs: int, hidden: int) -> tuple[Any, Any, Any, Any]:
    """W1 (h, inputs), b1 (h,), W2 (2, h), b2 (2,) of a parameter vector, numpy or torch."""
    ends = np.cumsum([hidden * inputs, hidden, NUM_OUTPUTS * hidden, NUM_OUTPUTS])
    W1, b1, W2, b2 = (theta[i:j] for i, j in zip([0, *ends[:-1]], ends, strict=True))
    return W1.reshape(hidden, inputs), b1, W2.reshape(NUM_OUTPUTS, hidden), b2


def initial_theta(inputs: int, hidden: int, targets: Array, seed: int) -> Array:
    """Random weights of variance 1 / fan-in, and the mean of the targets (N, 2) as output bias."""
    rng = np.random.default_rng(seed)
    first = rng.standard_normal((hidden, inputs)) / np.sqrt(inputs)
    second = rng.standard_normal((NUM_OUTPUTS, hidden)) / np.sqrt(hidden)
    return np.concatenate(
        [first.ravel(), np.zeros(hidden), second.ravel(), targets.mean(axis=0) - second.sum(1) / 2]
    )


class TorchModel:
    """f and its Jacobian by torch, in double precision.

    Args:
        inputs: number of inputs.
        hidden: number of hidden neurons.

    Raises:
        ConfigError: torch is not installed.
    """

    def __init__(self, inputs: int, hidden: int) -> None:
        self._torch = torch = require_torch()

        def forward(theta: Any, u: Any) -> Any:
            W1, b1, W2, b2 = unpack(theta, inputs, hidden)
            return W2 @ torch.sigmoid(W1 @ u + b1) + b2

        self._forward = torch.func.vmap(forward, in_dims=(None, 0))
        self._jacobian = torch.func.vmap(torch.func.jacrev(forward), in_dims=(None, 0))

    def _call(self, function: Callable[[Any, Any], Any], theta: Array, u: Array) -> Array:
        with self._torch.no_grad():
            tensors = (self._torch.from_numpy(np.ascontiguousarray(x)) for x in (theta, u))
            return np.asarray(function(*tensors).numpy())

    def outputs(self, theta: Array, u: Array) -> Array:
        """f (N, 2) of inputs u (N, n)."""
        return self._call(self._forward, theta, u)

    def jacobian(self, theta: Array, u: Array) -> Array:
        """df/dtheta (N, 2, len(theta))."""
        return self._call(self._jacobian, theta, u)


def fit(
    model: TorchModel,
    theta: Array,
    train: tuple[Array, Array],
    test: tuple[Array, Array],
    evaluations: int,
) -> Fit:
    """Levenberg-Marquardt from `theta` on.

    Args:
        model: f.
        theta: where to start.
        train: standardised inputs (N, n) and targets (N, 2).
        test: the same, of rows that training does not see; may be empty.
        evaluations: of the residuals, at most.
    """
    curve: list[tuple[float, float]] = []

    def residuals(theta: Array) -> Array:
        return (model.outputs(theta, train[0]) - train[1]).ravel()

    # MINPACK asks for the Jacobian at the start and after each successful step.
    def jacobian(theta: Array) -> Array:
        curve.append((_rms(model, theta, train), _rms(model, theta, test)))
        return model.jacobian(theta, train[0]).reshape(-1, len(theta))

    found = least_squares(
        residuals, theta, jac=jacobian, method="lm", max_nfev=evaluations, x_scale=1.0
    )
    curve.append((_rms(model, found.x, train), _rms(model, found.x, test)))
    return Fit(found.x, np.array(curve), int(found.nfev), found.status > 0)


def _rms(model: TorchModel, theta: Array, rows: tuple[Array, Array]) -> float:
    if not len(rows[0]):
        return float("nan")
    return float(np.sqrt(np.mean((model.outputs(theta, rows[0]) - rows[1]) ** 2)))
