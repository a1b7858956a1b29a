"""From recordings to Green's functions.

============================  ==================================================================
`excitation`                  `PlayedExcitation`, `StaggeredSignal`: what plays
`timing`                      `ClockFitter`: start offset and clock ratio
`estimator.sequential`        `SequentialEstimator`; `estimator.staggered` has `StaggeredEstimator`
`estimator.raw_estimation`    `estimate_positions`: kept recordings of any program into responses
`estimator.defect_finder`     `DefectFinder`: what a fit leaves unexplained
`neighbour_judge`             `judge_rows`: positions against all others
`mirror_map`                  `MirrorMap`, `fit_mirror_map`
`check`                       `check_bank`
============================  ==================================================================
"""

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
Complex64Array = NDArray[np.complex64]
Complex128Array = NDArray[np.complex128]
Int64Array = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
