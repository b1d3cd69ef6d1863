"""Building a map from the states of odometry, tracked keypoints and IMU samples."""

import itertools
from collections.abc import Sequence
from concurrent.futures import Future

from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions, TrackReport
from maplab_py.algorithms.landmarks.tracks import init_tracks
from maplab_py.array_types import F64, U8
from maplab_py.errors import EstimationError
from maplab_py.frontend.backfill import Backfill
from maplab_py.frontend.dead_reckoning import Tie, tied
from maplab_py.frontend.failures.watch import SensorWatch, replace_failed
from maplab_py.frontend.recorded_mission import RecordedMission, VertexFrames, mission_map
from maplab_py.frontend.run_options import MapBuilderOptions
from maplab_py.interop.recordings.protocol import RecordedSensors
from maplab_py.progress import SILENT, Progress
from maplab_py.storage.resources.new import NewResources
from maplab_py.vimap import VIMap, merge, nav_state

_EARLY = 0.95
"""A frame may come this share of the interval after the last vertex (maplab's tolerance)."""
_MIN_VERTICES = 2


class MapBuilder:
    """Collects vertices; `finish` makes the map. Each start of the odometry is a mission of the map."""

    def __init__(self, device: RecordedSensors, options: MapBuilderOptions | None = None) -> None:
        """Start without missions.

        Raises:
            UserError: The temporary folder cannot be made.
        """
        self._device, self._options = device, options or MapBuilderOptions()
        seed = f"{device.rig_id} {device.imu_id}".encode()
        self._images = None
        if self._options.save_image_as_resources:
            self._images = NewResources(seed=seed)
        # records of all missions, those without vertices included; the last one grows
        self.missions: list[RecordedMission] = []
        self._devices: list[RecordedSensors] = []  # of the missions
        self._waiting: dict[int, tuple[VertexFrames, list[int]]] = {}

    @property
    def vertices(self) -> int:
        """Number of vertices of all missions."""
        return sum(len(mission) for mission in self.missions)

    def start_mission(self, device: RecordedSensors | None = None) -> None:
        """Begin a mission: the next vertex is its root.

        Args:
            device: The sensors with other figures; None = as before. With another calibration they need
                other ids, so that both are in the map; under the same ids they replace those before.
        """
        self._device = new = device or self._device
        self.missions.append(RecordedMission())
        ids = new.imu_id, new.rig_id
        self._devices = [new if (d.imu_id, d.rig_id) == ids else d for d in self._devices] + [new]

    def calibrate(self, device: RecordedSensors) -> None:
        """Take the sensors with another calibration, for all missions."""
        self._device, self._devices = device, [device] * len(self.missions)

    def is_due(self, time_ns: int) -> bool:
        """Tell whether a frame of this time becomes a vertex."""
        last_ns = self.missions[-1].last_ns
        return last_ns is None or time_ns - last_ns >= self._interval_ns

    @property
    def _interval_ns(self) -> float:
        return _EARLY * 1e9 / self._options.nframe_sync_max_output_frequency_hz

    def is_due_before_start(self, stamp_ns: int) -> bool:
        """Tell whether a frame without a state may become a vertex when its state is found."""
        last_ns = next(reversed(self._waiting), None)
        return last_ns is None or stamp_ns - last_ns >= self._interval_ns

    def add_before_start(
        self,
        stamp_ns: int,
        frames: VertexFrames,
        images: Sequence[U8 | None] = (),
    ) -> None:
        """Keep a frame for which there is no state yet; see `add_vertex`."""
        self._waiting[stamp_ns] = frames, self._image_rows(frames, images)

    def forget_before_start(self) -> None:
        """Forget the frames for which there is no state."""
        self._waiting.clear()

    def fill(self, backfill: Backfill) -> None:
        """Make vertices of the frames before the first vertex of the mission, and refine the others."""
        mission, earlier = self.missions[-1], RecordedMission()
        first_ns = int(mission.states[0].time_ns[0]) if len(mission) else 0
        for row, frame in enumerate(backfill.frames):
            if frame.time_ns <= first_ns and row:
                earlier.add_imu(frame.imu_times_ns, frame.accel_gyro)
            kept = self._waiting.get(int(backfill.stamps_ns[row]))
            if frame.time_ns < first_ns and kept is not None:
                earlier.add_vertex(backfill.states.row(row), *kept)
        if len(earlier) and earlier.has_samples_until(first_ns):
            mission.prepend(earlier, earlier.samples())
        mission.refine(backfill.states)
        self._waiting.clear()

    def add_vertex(
        self,
        state: nav_state.NavState,
        frames: VertexFrames,
        images: Sequence[U8 | None] = (),
        covariance: F64 | None = None,
    ) -> None:
        """Add a vertex at the time up to which samples have been added.

        Args:
            state: The state of the body then.
            frames: Keypoints by camera, maybe later; None where a camera has none. Descriptors are required.
            images: Images by camera, kept as resources if the options say so.
            covariance: Of the state (15, 15), order [p, theta, v, b_g, b_a]; None = not known.

        Raises:
            UserError: An image cannot be written.
        """
        rows = self._image_rows(frames, images)
        self.missions[-1].add_vertex(state, frames, rows, covariance)

    def _image_rows(self, frames: VertexFrames, images: Sequence[U8 | None]) -> list[int]:
        """Keep images as resources; return their rows, -1 where there is none."""
        of_cameras = images if isinstance(frames, Future) else frames
        has_keypoints = [frame is not None for frame in of_cameras]
        if self._images is None:
            return [-1] * len(has_keypoints)
        return [
            self._images.add_image(image) if is_there and image is not None else -1
            for is_there, image in zip(
                has_keypoints, images or [None] * len(has_keypoints), strict=True
            )
        ]

    def replace_samples(self, watch: SensorWatch) -> None:
        """Replace the samples of parts of the IMU that had failed; see `replace_failed`."""
        assert self._device.imu is not None
        for mission in self.missions:
            replace_failed(mission, watch, self._device.imu.gravity_magnitude_mps2)

    def ties(self) -> list[Tie | None]:
        """Return how each mission of the map is tied to the one before; None = it is not, as the first."""
        result: list[Tie | None] = [None]
        for (a, device), (b, _) in itertools.pairwise(self._used_missions()):
            assert device.imu is not None
            result.append(a.tie_to(b, device.imu))
        return result

    def _used_missions(self) -> list[tuple[RecordedMission, RecordedSensors]]:
        pairs = zip(self.missions, self._devices, strict=True)
        return [(mission, device) for mission, device in pairs if len(mission) >= _MIN_VERTICES]

    def make_map(self) -> VIMap:
        """Return the map so far, without landmarks; missions of fewer than two vertices are left out.

        Missions that IMU samples lead to are placed by them, beside a loop closure edge that says how surely.

        Raises:
            EstimationError: No mission has two vertices.
        """
        used = self._used_missions()
        if not used:
            raise EstimationError(
                "there is no map: the odometry has estimated fewer than two vertices"
            )
        result = mission_map(used[0][1], used[0][0], self._images)
        for (mission, device), tie in zip(used[1:], self.ties()[1:], strict=True):
            part = mission_map(device, mission, self._images)
            result = merge.stack(result, part) if tie is None else tied(result, part, tie)
        return result

    def make_part(self, mission: int, first: int) -> VIMap | None:
        """Return a mission from a vertex (its row) on, with landmarks; None of fewer than two vertices.

        Ids are not those of the whole map.
        """
        part = self.missions[mission].part(first)
        if len(part) < _MIN_VERTICES:
            return None
        vi_map = mission_map(self._devices[mission], part, self._images)
        return init_tracks(vi_map, LandmarkQualityOptions(), across_cameras=True)[0]

    def finish(self, *, progress: Progress = SILENT) -> tuple[VIMap, TrackReport]:
        """Return the map with landmarks: tracks are triangulated, and their quality is evaluated.

        Raises:
            EstimationError: No mission has two vertices.
        """
        return init_tracks(
            self.make_map(), LandmarkQualityOptions(), across_cameras=True, progress=progress
        )
