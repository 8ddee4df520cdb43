"""Innovations of a linear model with unknown inputs; white residuals if the model holds."""

from dataclasses import dataclass, field

import numpy as np

from stewart_drake.types import Array


@dataclass
class Innovations:
    """Kalman filter of residuals r_k (p,) of a model, k = 0 ... m - 1, known at the start.

    State:       x_0 = 0,  x_k+1 = Phi_k x_k + G_k w_k,  r_k = C_k x_k + v_k
    Inputs:      w_k and v_k independent, with standard deviations 1 and `std`
    Covariance:  S_k = C_k P_k C_k' + std^2 = L_k L_k',  K_k = P_k C_k' / S_k
                 P_k+1 = Phi_k (P_k - K_k S_k K_k') Phi_k' + G_k G_k'
    Output:      e_k = L_k^-1 (r_k - C_k x_k),  x_k+1 = Phi_k (x_k + K_k L_k e_k)

    The e_k are independent, with covariance 1. So least squares of e are the best estimate.
    """

    outputs: Array  # C (m, p, n)
    maps: Array  # Phi (m - 1, n, n)
    inputs: Array  # G (m - 1, n, q)
    std: float
    _whiten: Array = field(init=False)  # L^-1 (m, p, p)
    _gains: Array = field(init=False)  # Phi K L (m - 1, n, p)

    def __post_init__(self) -> None:
        P, noise = np.zeros(self.maps.shape[1:]), self.std**2 * np.eye(self.outputs.shape[1])
        roots, gains = [], []
        for k, C in enumerate(self.outputs):
            roots.append(np.linalg.cholesky(C @ P @ C.T + noise))
            if k < len(self.maps):
                Phi, G, KL = self.maps[k], self.inputs[k], np.linalg.solve(roots[k], C @ P).T
                gains.append(Phi @ KL)
                P = Phi @ (P - KL @ KL.T) @ Phi.T + G @ G.T
                P = (P + P.T) / 2
        self._whiten, self._gains = np.linalg.inv(roots), np.array(gains)

    def __call__(self, residuals: Array) -> Array:
        """Return the innovations of residuals (m, p, ...), each column by itself."""
        flat = residuals.reshape(*residuals.shape[:2], -1)
        found, x = np.empty_like(flat), np.zeros((self.maps.shape[1], flat.shape[2]))
        for k, r in enumerate(flat):
            found[k] = self._whiten[k] @ (r - self.outputs[k] @ x)
            if k < len(self.maps):
                x = self.maps[k] @ x + self._gains[k] @ found[k]
        return found.reshape(residuals.shape)
