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


@dataclasses.dataclass(frozen=True, eq=False)
class SimulatedSession:
    """One session: its map with odometry drift, its truth, and what was recorded."""

    vi_map: VIMap
    truth: Truth
    recorded: RecordedSession


class SessionSimulator:
    """The world of a scenario, in which any of its sessions can be simulated by itself.

    Attributes:
        world: The world that all sessions share.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Make the world.

        Raises:
            UserError: The scenario cannot be simulated.
        """
        seeds = scenario.seeds
        self._scenario = scenario
        self.world = make_world(scenario.world, _generator(seeds.world, _WORLD))
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
        scenario, seeds, world = self._scenario, self._scenario.seeds, self.world
        of_session = SessionSeeds(
            motion=_generator(seeds.motion, _MOTION, number),
            measurement=_generator(seeds.measurement, _MEASUREMENT, number),
            appearance=_generator(seeds.appearance, _APPEARANCE, number),
            other=_generator(seeds.measurement, _OTHER, number),
            ids=np.random.default_rng(
                [_IDS, number, *(int(seed) for seed in dataclasses.astuple(seeds))]
            ),
        )
        look = make_session_appearance(self._appearance, of_session.appearance)
        device = make_device(scenario, scenario.sessions[number].device, number)
        recording = record(scenario, number, world, device, look, of_session)
        vi_map, truth = session_map(scenario, world, device, recording, of_session)
        if self._lidar is not None:
            noise = _generator(seeds.measurement, _LIDAR, number)
            vi_map = with_lidar_clouds(vi_map, device.imu_id, recording, self._lidar, noise)
        return SimulatedSession(vi_map, truth, RecordedSession(device, recording))


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
