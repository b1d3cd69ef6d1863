"""Record of the localisation of all frames of a run, as a report and as a file."""

from array import array
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.frontend import reports
from maplab_py.frontend.localization import online
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.geometry import se3
from maplab_py.interop.text_table import format_rows
from maplab_py.output_files import write_text

_POSE = "p_{0}_x [m],p_{0}_y [m],p_{0}_z [m],q_{0}_w,q_{0}_x,q_{0}_y,q_{0}_z"
_HEADER = (
    "#timestamp [ns],"
    + ",".join(_POSE.format(name) for name in ("GI", "MI", "GM"))
    + ",v_MI_x [m/s],v_MI_y [m/s],v_MI_z [m/s],b_g_x [rad/s],b_g_y [rad/s],b_g_z [rad/s],"
    "b_a_x [m/s^2],b_a_y [m/s^2],b_a_z [m/s^2],sigma_GI [m],is_localized,mission\n"
)


class LocalizationRecord:
    """Collects the poses of a run."""

    def __init__(self) -> None:
        self._times_ns = array("q")
        self._rows = array("d")  # rows of 33 numbers

    def add(self, frame: online.LocalizedFrame, update: OdometryUpdate) -> None:
        """Take a frame; without a state of the odometry there is nothing to keep."""
        state, pose = update.state, frame.pose
        if state is None:
            return
        self._times_ns.append(frame.time_ns)
        T_G_I = T_G_M = se3.identity()
        sigma_m = 0.0
        if pose is not None:
            T_G_I, T_G_M = pose.T_G_I, pose.T_G_M
            variance = float(np.trace(pose.covariance[:3, :3]))
            sigma_m = float(np.sqrt(variance)) if np.isfinite(variance) else 0.0
        for T in (T_G_I, state.T_M_I[0], T_G_M):
            self._rows.extend(T[[4, 5, 6, 3, 0, 1, 2]])
        for column in (state.v_M, state.gyro_bias, state.accel_bias):
            self._rows.extend(column[0])
        self._rows.extend((sigma_m, float(pose is not None), float(update.mission)))

    def __len__(self) -> int:
        return len(self._times_ns)

    @property
    def columns(self) -> tuple[I64, F64]:
        """Times (N,) and the columns of the file (N, 33) that follow them."""
        times_ns = np.array(self._times_ns, dtype=np.int64)
        return times_ns, np.array(self._rows).reshape(len(times_ns), 33)

    def write(self, path: Path, *, overwrite: bool = False) -> None:
        """Write one line per frame; where `is_localized` is 0, poses in G are the identity.

        Raises:
            UserError: The file exists and `overwrite` is not set, or it cannot be written.
        """
        times_ns, values = self.columns
        rows = format_rows("%d" + ",%.17g" * 31 + ",%d,%d", [times_ns, values])
        write_text(path, (text for part in ([_HEADER], rows) for text in part), overwrite=overwrite)


def summarised(
    localization: online.OnlineLocalization, first_ns: int, csv_file: Path | None
) -> reports.LocalizationSummary:
    """Return the counts of a run that began at a time."""
    counts = localization.counts
    first_s = None
    if counts.first_localized_ns >= 0:
        first_s = (counts.first_localized_ns - first_ns) * 1e-9
    return reports.LocalizationSummary(
        map_name=localization.map_name,
        mode=localization.options.mode,
        map_landmarks=localization.map_landmarks,
        localized_share=counts.localized_frames / max(counts.frames, 1),
        first_localized_s=first_s,
        queries=counts.queries,
        answers_by_index=counts.answers_by_index,
        answers_by_tracking=counts.answers_by_tracking,
        matches=counts.matches,
        starts=counts.starts,
        disagreeing=counts.disagreeing,
        late=counts.late,
        refused=dict(counts.refused),
        csv_file=csv_file,
    )
