"""Compile the kernels of storage by running each once."""

from __future__ import annotations

import numpy as np

from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.message_ids import LARGE_MESSAGE, ids_of_parts
from maplab_py.storage.message_scan import estimate


def compile_scan() -> None:
    """Compile the walk over the fields of a message and the reading of ids."""
    from maplab_py.storage.id_fields_kernel import ids_of_field

    message = pb.VIMapMetadata()
    message.files.add(file_type=0, path="missions")
    ids_of_parts(bytes(LARGE_MESSAGE), 10, (1, 2))
    begin = np.zeros(1, dtype=np.int64)
    ids_of_field(np.frombuffer(bytes(1), dtype=np.uint8), begin[:0], begin[:0], 1, 0)
    estimate(message.SerializeToString(), pb.VIMapMetadata.DESCRIPTOR)  # type: ignore[arg-type]
