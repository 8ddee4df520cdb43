"""The Popov-Belevitch-Hautus test by smallest singular values.

(A, B) is controllable if and only if [lambda I - A, B] has full row rank for every eigenvalue
lambda of A; stabilisable, if for every one on or outside the stability boundary. The smallest
singular value tells how far a pair is from failing, which powers of A (the controllability matrix)
cannot: they lose all digits beyond a few states.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def pbh_margins(A: Array, B: Array, eigenvalues: NDArray[np.complex128]) -> Array:
    """Smallest singular value of [lambda I - A, B] (n, n + m) for each of the eigenvalues (k,)."""
    n = A.shape[0]
    if eigenvalues.size == 0:
        return np.empty(0)
    real = np.all(np.abs(eigenvalues.imag) <= 1e-12 * np.abs(eigenvalues))
    # Real arithmetic takes half the time.
    shifted = (eigenvalues.real if real else eigenvalues)[:, None, None] * np.eye(n) - A
    pencil = np.concatenate([shifted, np.broadcast_to(B, (len(eigenvalues), *B.shape))], axis=2)
    return np.linalg.svd(pencil, compute_uv=False)[:, -1]


def distinct(values: NDArray[np.complex128], resolution: float) -> NDArray[np.complex128]:
    """One of each group that agrees to `resolution`, as far as defective eigenvalues spread."""
    grid = np.round(values / resolution)
    _, first = np.unique(grid, return_index=True)
    return values[first]
