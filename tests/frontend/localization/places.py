"""A map whose poses are true, and a session in it that odometry replays, with its truth."""

import dataclasses
import functools

import numpy as np

from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import evaluate_quality
from maplab_py.algorithms.summary.options import SummaryMapOptions
from maplab_py.algorithms.summary.summary import make_summary_map
from maplab_py.array_types import F64, I64
from maplab_py.frontend.localization.map_source import SearchedMap, of_summary
from maplab_py.frontend.localization.online import LocalizedFrame, OnlineLocalization
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.frontend.odometry import Odometry
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.stream import EventStream
from maplab_py.interop.trajectories import Trajectory
from maplab_py.simulation.scenario import MeasurementOptions, Scenario, SessionOptions, WorldOptions
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.truth import true_map
from maplab_py.storage.summary_map import SummaryMap
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import IdIndex
from tests.frontend.known_start import KnownStart, updates_of
from tests.support.noiseless import without_noise


@dataclasses.dataclass(frozen=True, eq=False)
class Place:
    """A map in its true frame G, and a query."""

    vi_map: VIMap
    query: VIMap
    start: KnownStart
    times_ns: I64  # (V,) of the query
    T_G_I: F64  # (V, 7) its true poses

    def recording(self) -> MapRecording:
        return MapRecording(self.query, 0)

    def errors_m(self, frames: list[LocalizedFrame]) -> F64:
        """Return the position errors (N,) of the frames that have a pose."""
        used = [frame for frame in frames if frame.pose is not None]
        rows = np.searchsorted(self.times_ns, [frame.time_ns for frame in used])
        p_G_I = np.array([f.pose.T_G_I[4:] for f in used if f.pose]).reshape(-1, 3)
        return np.linalg.norm(p_G_I - self.T_G_I[rows, 4:], axis=1)


def place() -> Place:
    return place_of(
        SessionOptions(duration_s=7.0, turns=0.4, start_turn=0.2, height_m=1.7),
    )


@functools.cache
def place_of(
    session: SessionOptions, *, keypoint_sigma_px: float = 0.8, rate_hz: float = 5.0
) -> Place:
    """Return the map of a flight, and another session in the same room."""
    scenario = Scenario(
        world=WorldOptions(landmarks_per_room=1500),
        measurement=MeasurementOptions(
            frame_rate_hz=rate_hz, max_keypoints=120, keypoint_sigma_px=keypoint_sigma_px
        ),
        sessions=(SessionOptions(duration_s=14.0, turns=1.0), session),
    )
    scenario = dataclasses.replace(scenario, drift=without_noise(scenario).drift)
    data = simulate(scenario)
    first, query = data.maps
    T_G_M = data.truth.T_G_M[:1]
    first = first.replace(baseframes=first.baseframes.replace(T_G_M=T_G_M))
    quality = LandmarkQualityOptions(min_observers=3, min_observation_angle_deg=2.0)
    v = true_map(query, data.truth).vertices
    truth = Trajectory(v.timestamp_ns, v.T_M_I, v.v_M, v.gyro_bias, v.accel_bias)
    row = IdIndex(data.truth.vertex_id).rows(query.vertices.id)
    return Place(
        evaluate_quality(first, quality)[0], query, KnownStart(truth, with_biases=True),
        query.vertices.timestamp_ns, data.truth.T_G_I[row],
    )  # fmt: skip


@functools.cache
def summary() -> SummaryMap:
    return make_summary_map(place().vi_map, SummaryMapOptions(covariances=True))


def searched(changed: SummaryMap | None = None, *, with_covariances: bool = False) -> SearchedMap:
    return of_summary(changed or summary(), "summary", with_covariances=with_covariances)


def run(
    options: OnlineLocalizationOptions,
    map_: SearchedMap | None = None,
    where: Place | None = None,
    features: str = "",
) -> tuple[OnlineLocalization, list[LocalizedFrame], list[OdometryUpdate]]:
    """Localise the whole query; with features by a network its updates seem to have images."""
    where = where or place()
    recording = where.recording()
    rule = options.rule if options.mode == "vil" else None
    odometry = Odometry(recording.device, make_starter=where.start, map_rule=rule)
    localization = OnlineLocalization(
        map_ or searched(), recording.device, options, features=features
    )
    frames, updates = [], []
    images = (np.zeros((8, 8), dtype=np.uint8),) if features else ()
    for update in updates_of(odometry, EventStream(recording)):
        updates.append(dataclasses.replace(update, images=images))
        frames.append(localization.after_frame(updates[-1], odometry.smoother))
    return localization, frames, updates
