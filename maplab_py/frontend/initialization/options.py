"""Options of the initialisation."""

from maplab_py.errors import FlagError
from maplab_py.options import Options, option


class InitializationOptions(Options, prefix="vio_initialization_"):
    """Conditions for the start of the estimator."""

    rest_s: float = option(1.0, gt=0, lt=1e6)
    """Time at rest from which the estimator starts"""
    rest_disparity_px: float = option(0.5, gt=0, lt=1e6)
    """Largest median disparity in 0.1 s at rest, turns included; half of it over half a second and longer,
    noise of the tracks removed, where there are so many images"""
    rest_accel_deviation_mps2: float = option(0.25, gt=0, lt=1e6)
    """Largest deviation of the accelerometer at rest"""
    rest_gyro_deviation_radps: float = option(0.05, gt=0, lt=1e6)
    """Largest deviation of the gyroscope at rest"""
    min_rig_s: float = option(1.5, gt=0, lt=1e6)
    """Shortest time in motion for cameras that see the same points"""
    min_mono_s: float = option(1.5, gt=0, lt=1e6)
    """Shortest time in motion for a single camera"""
    longest_s: float = option(4.0, gt=0, lt=1e6)
    """Time in motion that is used, the latest part"""
    retry_s: float = option(0.25, gt=0, lt=1e6)
    """Shortest time between two attempts; it grows where the scale is far from known, and with the time that
    has passed"""
    keyframe_interval_s: float = option(0.1, gt=0, lt=1e6)
    """Shortest time between the frames that are used"""
    most_keyframes: int = option(16, ge=4, lt=1e6)
    """Largest number of frames that are used of cameras that see the same points"""
    most_mono_keyframes: int = option(28, ge=4, lt=1e6)
    """Largest number of frames that are used of a single camera"""
    min_landmarks: int = option(20, gt=0, lt=1e6)
    """Smallest number of landmarks"""
    max_scale_sigma: float = option(0.03, gt=0, lt=1e6)
    """Largest standard deviation of the scale, as a share of it"""
    early_scale_sigma: float = option(0.015, gt=0, lt=1e6)
    """The same for a single camera before --vio_initialization_early_s has passed"""
    early_s: float = option(3.9, gt=0, lt=1e6)
    """Time during which a single camera waits for the better scale, its attempt included"""
    max_rig_sigma_m: float = option(0.01, gt=0, lt=1e6)
    """Cameras that see the same points need not move when the distance moved is known so well"""
    max_tilt_sigma_deg: float = option(1.5, gt=0, lt=1e6)
    """Largest standard deviation of the direction of gravity"""
    patience_s: float = option(5.0, gt=0, lt=1e6)
    """Time after which the limits of scale and gravity grow with the time that has passed"""
    provisional_s: float = option(2.5, gt=0, lt=1e6)
    """Time after which the estimator starts with what is known, and follows scale, velocity and biases once
    they show"""
    provisional_scale_sigma: float = option(0.06, gt=0, lt=1e6)
    """Standard deviation of the scale, as a share of it, below which it waits up to
    --vio_initialization_promising_s instead"""
    promising_s: float = option(3.9, gt=0, lt=1e6)
    """Longest time to wait for a scale that is nearly known, its attempt included"""
    max_error_px: float = option(1.5, gt=0, lt=1e6)
    """Largest median reprojection error after the refinement"""
    gyro_bias_sigma_radps: float = option(0.1, gt=0, lt=1e6)
    """Standard deviation of the gyroscope's bias before the start"""
    accel_bias_sigma_mps2: float = option(0.2, gt=0, lt=1e6)
    """Standard deviation of the accelerometer's bias before the start, unless it walks farther in an hour"""
    least_gyro_noise_density: float = option(7e-4, gt=0, lt=1e6, unit="rad/s/sqrt(Hz)")
    """Noise of the gyroscope, if the calibration says less"""
    least_accel_noise_density: float = option(0.016, gt=0, lt=1e6, unit="m/s^2/sqrt(Hz)")
    """Noise of the accelerometer, if the calibration says less"""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("rest_s", "min_rig_s", "min_mono_s"):
            if getattr(self, name) > self.longest_s:
                raise FlagError(
                    f"--{self.flag_prefix}{name}={getattr(self, name):g} is longer than "
                    f"--{self.flag_prefix}longest_s={self.longest_s:g}"
                )
