"""A map server that robots feed with submaps through a spool.

From Python::

    from maplab_py.server import MapServer, MapServerOptions, Spool

    options = MapServerOptions(merged_map_folder="city")
    report = MapServer(Spool(Path("spool")), options).run()
"""

from maplab_py.server.options import IncrementalOptions, MapServerOptions, ServiceOptions
from maplab_py.server.server import MapServer
from maplab_py.server.spool import Spool, push

__all__ = [
    "IncrementalOptions",
    "MapServer",
    "MapServerOptions",
    "ServiceOptions",
    "Spool",
    "push",
]
