"""Scenarios without errors of measurements."""

import dataclasses

from maplab_py.simulation.scenario import CalibrationOptions, Scenario


def without_noise(scenario: Scenario) -> Scenario:
    """Return the scenario with perfect sensors, a perfect tracker and no drift."""
    zero = 0.0
    return dataclasses.replace(
        scenario,
        imu=dataclasses.replace(
            scenario.imu,
            gyro_noise_density=zero,
            accel_noise_density=zero,
            gyro_bias_walk=zero,
            accel_bias_walk=zero,
            g_sensitivity=zero,
            lever_arm_m=(zero, zero, zero),
            warming_scale=zero,
            time_offset_s=zero,
            time_jitter_s=zero,
        ),
        measurement=dataclasses.replace(
            scenario.measurement,
            keypoint_sigma_px=zero,
            identity_swap_share=zero,
            track_drift_share=zero,
            clutter_share=zero,
        ),
        drift=dataclasses.replace(
            scenario.drift,
            position_walk=zero,
            yaw_walk_deg=zero,
            tilt_sigma_deg=zero,
            scale_sigma=zero,
            velocity_sigma=zero,
            gyro_bias_sigma=zero,
            accel_bias_sigma=zero,
        ),
        calibration=CalibrationOptions(),
    )
