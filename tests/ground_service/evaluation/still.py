"""A Moon that does not turn."""

import numpy as np
from numpy.typing import ArrayLike


class Still:
    """Mean-Earth and principal axes are those of ICRF."""

    name = "still"

    def mcmf_from_icrf(self, tdb_s: ArrayLike) -> np.ndarray:
        return np.broadcast_to(np.eye(3), (*np.shape(tdb_s), 3, 3)).copy()

    def pa_from_icrf(self, tdb_s: ArrayLike) -> np.ndarray:
        return self.mcmf_from_icrf(tdb_s)
