"""Names of the types of arrays, one for the whole project."""

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
U64 = NDArray[np.uint64]
U32 = NDArray[np.uint32]
U8 = NDArray[np.uint8]
I8 = NDArray[np.int8]
Mask = NDArray[np.bool_]

__all__ = ["F32", "F64", "I8", "I32", "I64", "U8", "U32", "U64", "Mask", "NDArray"]
