"""Types of arrays that annotations share."""

import numpy as np
from numpy.typing import ArrayLike as _ArrayLike
from numpy.typing import NDArray
from typing_extensions import TypeAliasType

# Named, so that `help` shows the names and not the unions behind them.
Array = TypeAliasType("Array", NDArray[np.float64])
ArrayLike = TypeAliasType("ArrayLike", _ArrayLike)
Flags = TypeAliasType("Flags", NDArray[np.bool_])
Complex = NDArray[np.complex128]
