"""Compile the kernel of storage by running it once on a tiny message."""

from __future__ import annotations

from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.message_scan import estimate


def compile_scan() -> None:
    """Compile the walk over the fields of a message."""
    message = pb.VIMapMetadata()
    message.files.add(file_type=0, path="missions")
    estimate(message.SerializeToString(), pb.VIMapMetadata.DESCRIPTOR)  # type: ignore[arg-type]
