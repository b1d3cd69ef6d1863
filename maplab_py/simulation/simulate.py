"""Simulate a scenario: maps and their ground truth."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.progress import SILENT, Progress
from maplab_py.simulation.appearance import make_appearance, make_session_appearance
from maplab_py.simulation.lidar import Lidar, with_lidar_clouds
from maplab_py.simulation.recording import Recording, SessionSeeds, record
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.sensors import Device, make_device
from maplab_py.simulation.session import session_map
from maplab_py.simulation.truth import Truth
from maplab_py.simulation.world import World, make_world
from maplab_py.vimap import VIMap

_WORLD, _MOTION, _MEASUREMENT, _APPEARANCE, _IDS, _OTHER, _LIDAR = range(7)
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


def simulate(scenario: Scenario, *, progress: Progress = SILENT) -> SimulatedData:
    """Simulate all sessions of a scenario. The same scenario gives the same bytes.

    Raises:
        UserError: The scenario cannot be simulated.
        Cancelled: The user wants to stop.
    """
    seeds = scenario.seeds
    world = make_world(scenario.world, _generator(seeds.world, _WORLD))
    appearance = make_appearance(
        scenario.appearance, world.look, _generator(seeds.appearance, _APPEARANCE)
    )
    lidar = None
    if scenario.lidar.rate_hz > 0.0:
        lidar = Lidar.of(world, scenario.lidar, _generator(seeds.world, _LIDAR))
    maps, truths, recordings = [], [], []
    for number in range(len(scenario.sessions)):
        progress.step(number, len(scenario.sessions), f"session {number + 1}")
        of_session = SessionSeeds(
            motion=_generator(seeds.motion, _MOTION, number),
            measurement=_generator(seeds.measurement, _MEASUREMENT, number),
            appearance=_generator(seeds.appearance, _APPEARANCE, number),
            other=_generator(seeds.measurement, _OTHER, number),
            ids=np.random.default_rng(
                [_IDS, number, *(int(seed) for seed in dataclasses.astuple(seeds))]
            ),
        )
        look = make_session_appearance(appearance, of_session.appearance)
        device = make_device(scenario, scenario.sessions[number].device, number)
        recording = record(scenario, number, world, device, look, of_session)
        vi_map, truth = session_map(scenario, world, device, recording, of_session)
        if lidar is not None:
            noise = _generator(seeds.measurement, _LIDAR, number)
            vi_map = with_lidar_clouds(vi_map, device.imu_id, recording, lidar, noise)
        maps.append(vi_map)
        truths.append(truth)
        recordings.append(RecordedSession(device, recording))
    return SimulatedData(maps, Truth.concatenate(truths), world, recordings)


def _generator(seed: int, stream: int, *session: int) -> np.random.Generator:
    """Return the generator of one stream; sessions count from one, zero is the whole world's."""
    return np.random.default_rng([seed, stream, *(number + 1 for number in session)])
