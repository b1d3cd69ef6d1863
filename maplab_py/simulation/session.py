"""One recorded session as a map with drifting states, and its truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import I64
from maplab_py.simulation.detection import Detections, sigma_of_octave
from maplab_py.simulation.drift import baseframe
from maplab_py.simulation.initial_landmarks import InitialLandmarks, initial_landmarks
from maplab_py.simulation.other_sensors import add_other_sensors
from maplab_py.simulation.recording import Recording, SessionSeeds
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.sensors import Device
from maplab_py.simulation.truth import Truth, session_truth
from maplab_py.simulation.world import World
from maplab_py.vimap import VIMap
from maplab_py.vimap.descriptors import binary_blocks
from maplab_py.vimap.ids import from_hex, random_ids
from maplab_py.vimap.table import starts_of_counts
from maplab_py.vimap.tables import (
    BaseFrames,
    FrameField,
    Frames,
    ImuEdges,
    ImuSamples,
    Keypoints,
    Landmarks,
    Missions,
    MissionSensor,
    Vertices,
)

_KEYPOINT_SCALE = 20.0
_MIN_SIGMA_PX = 0.1
"""Standard deviation of perfect keypoints in the map, which an estimator needs as weight."""


def session_map(
    scenario: Scenario, world: World, device: Device, recording: Recording, seeds: SessionSeeds
) -> tuple[VIMap, Truth]:
    """Return a recorded session as a map with drifting states, and its truth.

    Raises:
        UserError: The motion offers too few places for the loop closure edges.
    """
    landmarks = initial_landmarks(device, recording, scenario.measurement.min_track_length)
    vi_map = _assemble(scenario, device, recording, landmarks, seeds)
    vi_map, is_true = add_other_sensors(
        vi_map, device.imu_id, recording, scenario.other_sensors, seeds.other
    )
    return vi_map, session_truth(vi_map, recording, device, world, landmarks.point, is_true)


def _assemble(
    scenario: Scenario,
    device: Device,
    recording: Recording,
    initial: InitialLandmarks,
    seeds: SessionSeeds,
) -> VIMap:
    vertices = len(recording.time_ns)
    sensor_id = np.zeros((1, len(MissionSensor), 2), dtype=np.uint64)
    sensor_id[0, MissionSensor.IMU] = from_hex(device.imu_id)
    sensor_id[0, MissionSensor.NCAMERA] = from_hex(device.rig.id)
    landmarks = Landmarks.filled(
        len(initial.vertex),
        id=random_ids(len(initial.vertex), seeds.ids),
        vertex=initial.vertex,
        p_I=initial.p_I,
    )
    bias_error = seeds.measurement.standard_normal((2, 3))
    edges, samples = _imu_tables(recording, seeds)
    frames, keypoints = _image_tables(scenario, device, recording, initial.of_keypoint, seeds)
    T_G_M = baseframe(scenario.drift, seeds.measurement)
    mission_id, frame_id = random_ids(1, seeds.ids), random_ids(1, seeds.ids)
    return VIMap(
        sensors=device.sensor_set,
        missions=Missions.filled(
            1, id=mission_id, baseframe=[0], root_vertex=[0], sensor_id=sensor_id
        ),
        baseframes=BaseFrames.filled(1, id=frame_id, T_G_M=T_G_M[None]),
        vertices=Vertices.filled(
            vertices,
            id=random_ids(vertices, seeds.ids),
            mission=np.zeros(vertices, dtype=np.int32),
            T_M_I=recording.states.T_M_I,
            v_M=recording.states.v_M,
            accel_bias=recording.imu.accel_bias[recording.imu_row]
            + scenario.drift.accel_bias_sigma * bias_error[0],
            gyro_bias=recording.imu.gyro_bias[recording.imu_row]
            + scenario.drift.gyro_bias_sigma * bias_error[1],
            timestamp_ns=recording.time_ns,
            nframe_id=random_ids(vertices, seeds.ids),
        ),
        frames=frames,
        keypoints=keypoints,
        landmarks=landmarks,
        imu_edges=edges,
        imu_samples=samples,
    )


def _imu_tables(recording: Recording, seeds: SessionSeeds) -> tuple[ImuEdges, ImuSamples]:
    """Split the recording at the vertices; neighbouring edges share the boundary sample."""
    row = recording.imu_row
    count = np.diff(row) + 1
    edges = len(count)
    # edge e has the samples row[e] .. row[e + 1], both included
    first = np.repeat(row[:-1] - starts_of_counts(count)[:-1], count)
    rows = first + np.arange(int(count.sum()))
    table = ImuEdges.filled(
        edges,
        id=random_ids(edges, seeds.ids),
        from_vertex=np.arange(edges),
        to_vertex=np.arange(1, edges + 1),
        sample_count=count,
    )
    samples = ImuSamples.filled(
        len(rows),
        timestamp_ns=recording.imu_time_ns[rows],
        accel_gyro=recording.imu.accel_gyro[rows],
    )
    return table, samples


def _image_tables(
    scenario: Scenario,
    device: Device,
    recording: Recording,
    landmark_of: I64,
    seeds: SessionSeeds,
) -> tuple[Frames, Keypoints]:
    detections, cameras = recording.keypoints, len(device.rig.cameras)
    vertices = len(recording.time_ns)
    count = vertices * cameras
    present = FrameField.SIGMA | FrameField.SCALE | FrameField.TRACK_ID | FrameField.LANDMARK_ID
    delays = np.array([camera.line_delay_s for camera in scenario.cameras])
    if delays.any():
        present |= FrameField.TIME_OFFSET
    keypoint_count = np.bincount(detections.frame, minlength=count)
    frames = Frames.filled(
        count,
        id=random_ids(count, seeds.ids),
        vertex=np.repeat(np.arange(vertices), cameras),
        camera_index=np.tile(np.arange(cameras), vertices),
        timestamp_ns=np.repeat(recording.time_ns, cameras),
        keypoint_count=keypoint_count,
        descriptor_blocks=binary_blocks(keypoint_count, recording.descriptors.shape[1]),
        present=np.full(count, int(present)),
    )
    factor = scenario.calibration.keypoint_noise_factor
    sigma = np.maximum(
        factor * sigma_of_octave(scenario.measurement, detections.octave), _MIN_SIGMA_PX
    )
    no_offset = np.zeros((len(detections.frame), 0), dtype=np.int32)
    keypoints = Keypoints.filled(
        len(detections.frame),
        uv_px=detections.uv_px,
        sigma_px=sigma,
        scale=_KEYPOINT_SCALE * 2.0**detections.octave,
        time_offset_ns=_readout_ns(scenario, detections) if delays.any() else no_offset,
        track_id=detections.track,
        landmark=landmark_of,
        descriptor=recording.descriptors,
    )
    return frames, keypoints


def _readout_ns(scenario: Scenario, detections: Detections) -> NDArray[np.int32]:
    """Return when (K, 1) keypoints are read out, counted from the image's time stamp."""
    camera = detections.frame % len(scenario.cameras)
    delay_s = np.array([options.line_delay_s for options in scenario.cameras])[camera]
    middle = 0.5 * np.array([options.height_px for options in scenario.cameras])[camera]
    offset = np.round(1e9 * delay_s * (detections.uv_px[:, 1] - middle))
    return np.asarray(offset[:, None], dtype=np.int32)
