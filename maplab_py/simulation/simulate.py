"""Simulate a scenario: maps and their ground truth."""

import dataclasses
from typing import Self

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop.ply import PlyCloud, encode_ply
from maplab_py.progress import SILENT, Progress
from maplab_py.simulation.changes import visible_in_light, with_changes
from maplab_py.simulation.ray_caster import RayCaster, painted_boxes
from maplab_py.simulation.recording import Recording, SessionSeeds, record
from maplab_py.simulation.scenario import ImageOptions, LidarOptions, Scenario
from maplab_py.simulation.scene import (
    SessionAppearance,
    make_appearance,
    make_scene,
    make_session_appearance,
)
from maplab_py.simulation.sensors import Device, make_device
from maplab_py.simulation.session import session_map, with_sensor
from maplab_py.simulation.truth import Truth
from maplab_py.simulation.world import World, make_world
from maplab_py.storage.resources.new import NewResources
from maplab_py.vimap import MissionSensor, ResourceOwner, VIMap, random_ids

_WORLD, _MOTION, _MEASUREMENT, _APPEARANCE, _IDS, _OTHER, _LIDAR, _CHANGES, _LIGHT = range(9)
"""Streams of random numbers; a session's number selects within a stream."""


@dataclasses.dataclass(frozen=True, eq=False)
class RecordedSession:
    """A recorded session with its device."""

    device: Device
    recording: Recording


@dataclasses.dataclass(frozen=True, eq=False)
class SimulatedData:
    """One map per session with odometry drift, and the truth of all."""

    maps: list[VIMap]
    truth: Truth
    world: World
    recordings: list[RecordedSession]


@dataclasses.dataclass(frozen=True, eq=False)
class SimulatedSession:
    """One session: its map with odometry drift, its truth, and what was recorded."""

    vi_map: VIMap
    truth: Truth
    recorded: RecordedSession


class SessionSimulator:
    """The world of a scenario, in which any of its sessions can be simulated by itself."""

    def __init__(self, scenario: Scenario) -> None:
        """Make the world.

        Raises:
            UserError: The scenario cannot be simulated.
        """
        seeds = scenario.seeds
        self._scenario = scenario
        # the world that all sessions share
        self.world = make_world(scenario.world, _generator(seeds.world, _WORLD))
        if scenario.changes.are_any:
            if scenario.lidar.rate_hz > 0.0 or scenario.images.render:
                raise UserError("changes: neither lidars nor rendered images show them")
            self.world = with_changes(
                self.world,
                scenario.world,
                scenario.changes,
                len(scenario.sessions),
                _generator(seeds.world, _CHANGES),
            )
        self._appearance = make_appearance(
            scenario.appearance, self.world.look, _generator(seeds.appearance, _APPEARANCE)
        )
        self._lidar = None
        if scenario.lidar.rate_hz > 0.0:
            generator = _generator(seeds.world, _LIDAR)
            self._lidar = Lidar.of(self.world, scenario.lidar, generator)

    def session(self, number: int) -> SimulatedSession:
        """Simulate one session of the scenario; others have no influence on it.

        Raises:
            UserError: The session cannot be simulated.
        """
        scenario, seeds = self._scenario, self._scenario.seeds
        world = self.world.in_session(number)
        of_session = SessionSeeds(
            motion=_generator(seeds.motion, _MOTION, number),
            measurement=_generator(seeds.measurement, _MEASUREMENT, number),
            appearance=_generator(seeds.appearance, _APPEARANCE, number),
            other=_generator(seeds.measurement, _OTHER, number),
            ids=np.random.default_rng(
                [_IDS, number, *(int(seed) for seed in dataclasses.astuple(seeds))]
            ),
        )
        look = self._session_appearance(number, of_session.appearance)
        device = make_device(scenario, scenario.sessions[number].device, number)
        recording = record(scenario, number, world, device, look, of_session)
        vi_map, truth = session_map(scenario, world, device, recording, of_session)
        if self._lidar is not None:
            noise = _generator(seeds.measurement, _LIDAR, number)
            vi_map = with_lidar_clouds(vi_map, device.imu_id, recording, self._lidar, noise)
        return SimulatedSession(vi_map, truth, RecordedSession(device, recording))

    def _session_appearance(self, number: int, rng: np.random.Generator) -> SessionAppearance:
        """Return what can be seen in a session, and what it looks like in its light."""
        look = make_session_appearance(self._appearance, rng)
        light = self._scenario.sessions[number].light
        if self.world.exists is None:
            return look
        of_light = _generator(self._scenario.seeds.appearance, _LIGHT, light)
        change = of_light.standard_normal(look.change.shape, dtype=np.float32)
        is_there = look.is_there & self.world.exists[number] & visible_in_light(self.world, light)
        change *= np.float32(self._scenario.changes.light_change)
        return dataclasses.replace(look, change=look.change + change, is_there=is_there)


def simulate(scenario: Scenario, *, progress: Progress = SILENT) -> SimulatedData:
    """Simulate all sessions of a scenario. The same scenario gives the same bytes.

    Raises:
        UserError: The scenario cannot be simulated.
        Cancelled: The user wants to stop.
    """
    simulator = SessionSimulator(scenario)
    sessions = []
    for number in range(len(scenario.sessions)):
        progress.step(number, len(scenario.sessions), f"session {number + 1}")
        sessions.append(simulator.session(number))
    return SimulatedData(
        [session.vi_map for session in sessions],
        Truth.concatenate([session.truth for session in sessions]),
        simulator.world,
        [session.recorded for session in sessions],
    )


def _generator(seed: int, stream: int, *session: int) -> np.random.Generator:
    """Return the generator of one stream; sessions count from one, zero is the whole world's."""
    return np.random.default_rng([seed, stream, *(number + 1 for number in session)])


# A spinning lidar: clouds of the world's surfaces, as resources of the sensor in the session's map.
#
# A column of a cloud is a row of the ray caster: its rays lie in the plane through the lidar's axis that
# the column's azimuth gives.

CLOUDS_WITH_INTENSITY = 21
"""Number of the resource type of the clouds."""
_TEXEL_M = 0.1


@dataclasses.dataclass(frozen=True, eq=False)
class Lidar:
    """A lidar in a world."""

    caster: RayCaster
    options: LidarOptions
    T_L_column: F64  # (columns, 7) z axis horizontal, along the column's azimuth; y axis up
    slope: F64  # (rings,) tangents of the elevations

    @classmethod
    def of(cls, world: World, options: LidarOptions, rng: np.random.Generator) -> Self:
        """Prepare the rays of a lidar; `rng` paints what it sees."""
        scene = make_scene(world.bounds, world.boxes, ImageOptions(texel_m=_TEXEL_M), rng)
        elevation = np.deg2rad(np.linspace(options.lowest_deg, options.highest_deg, options.rings))
        slope = np.tan(elevation)
        rays = np.zeros((options.columns, options.rings, 2))
        rays[..., 1] = slope
        pitch_rad = max(np.ptp(elevation) / max(options.rings - 1, 1), 1e-3)
        caster = RayCaster.of(painted_boxes(scene), rays, 1.0 / pitch_rad)
        azimuth = 2.0 * np.pi * np.arange(options.columns) / options.columns
        cosine, sine, zero = np.cos(azimuth), np.sin(azimuth), np.zeros(options.columns)
        axes = [[-sine, zero, cosine], [cosine, zero, sine], [zero, zero + 1.0, zero]]
        q = so3.from_matrix(np.moveaxis(np.array(axes), 2, 0))
        return cls(caster, options, se3.make(q, np.zeros((options.columns, 3))), slope)

    def scan(self, T_G_L: F64, rng: np.random.Generator) -> PlyCloud:
        """Return the cloud in the lidar's frame L at a pose (7,), with noise along the rays.

        Intensities are grey values of the surfaces, 0 to 255.
        """
        o = self.options
        grey, depth = self.caster.render(se3.compose(T_G_L, self.T_L_column))
        length = np.sqrt(1.0 + self.slope**2)
        range_m = depth * length + o.range_sigma_m * rng.standard_normal(depth.shape)
        seen = (depth > 0.0) & (range_m >= o.min_range_m) & (range_m <= o.max_range_m)
        z = range_m / length
        p_column = np.stack([np.zeros_like(z), z * self.slope, z], axis=2)
        p_L = se3.transform(self.T_L_column[:, None], p_column)
        return PlyCloud(p_L[seen], intensity=np.asarray(np.round(grey[seen], 1), dtype=np.float64))


def with_lidar_clouds(
    vi_map: VIMap,
    imu_id: str,
    recording: Recording,
    lidar: Lidar,
    rng: np.random.Generator,
) -> VIMap:
    """Return the map of a session with a lidar and its clouds, half a period after the start and on.

    Raises:
        UserError: The temporary folder of the clouds cannot be written.
    """
    options = lidar.options
    words = random_ids(1, rng)[0]
    T_I_L = se3.make(so3.exp(options.turn_rad), np.asarray(options.position_m))
    first_s, last_s = recording.frame_s[0], recording.frame_s[-1]
    time_s = np.arange(first_s + 0.5 / options.rate_hz, last_s, 1.0 / options.rate_hz)
    time_ns = recording.time_ns[0] + np.round(1e9 * (time_s - first_s)).astype(np.int64)
    new = NewResources(seed=vi_map.missions.id[0].tobytes())
    for pose in recording.spline.poses_of(time_s, T_I_L):
        new.add(CLOUDS_WITH_INTENSITY, b"".join(encode_ply(lidar.scan(pose, rng))))
    mounted = with_sensor(vi_map, MissionSensor.LIDAR, words, imu_id, T_I_L)
    if not len(new):
        return mounted
    return new.attached(
        mounted,
        np.arange(len(new)),
        np.zeros(len(new), dtype=np.int64),
        ResourceOwner.SENSOR,
        sensor_id=words,
        timestamp_ns=time_ns,
    )
