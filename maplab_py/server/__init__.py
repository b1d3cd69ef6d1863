"""A map server that robots feed with submaps through a spool.

From Python::

    from maplab_py.server.options import MapServerOptions
    from maplab_py.server.server import MapServer
    from maplab_py.server.spool import Spool

    options = MapServerOptions(merged_map_folder="city")
    report = MapServer(Spool(Path("spool")), options).run()
"""
