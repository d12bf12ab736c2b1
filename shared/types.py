# SPDX-License-Identifier: Apache-2.0
"""Types of arrays by their element, of any shape, and the unit of stamps."""

import numpy as np
from numpy.typing import NDArray

Bools = NDArray[np.bool_]
Int8s = NDArray[np.int8]
Int16s = NDArray[np.int16]
Int32s = NDArray[np.int32]
Int64s = NDArray[np.int64]
UInt8s = NDArray[np.uint8]
UInt16s = NDArray[np.uint16]
UInt32s = NDArray[np.uint32]
UInt64s = NDArray[np.uint64]
Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]

NS_PER_S = 1_000_000_000
"""Nanoseconds per second: stamps count ns, settings and speeds count s."""
