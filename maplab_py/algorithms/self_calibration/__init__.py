"""Self-calibration of a device from informative motion segments of its own maps.

Packages, each of which uses only those before it:

- `estimation`: the least-squares problem of segments, its parameters, outliers and scale.
- `uncertainty`: covariances of the calibration, information of segments, test of a segment.
- `segments`: how a map is split into segments, which of them are kept, and their database.

`calibration` estimates and reports, `checks` compares the result with a limit and with parts of
the data (`self_calibrate`), and `pruning` removes segments from a database (`prune_segments`).
"""
