"""Opening of the map that the options name."""

from __future__ import annotations

from maplab_py.frontend.localization.map_source import open_map
from maplab_py.frontend.localization.online import OnlineLocalization
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.interop.recordings.protocol import RecordedSensors
from maplab_py.vision.features.extractors import KINDS


def opened_localization(
    options: OnlineLocalizationOptions, device: RecordedSensors, odometry: OdometryOptions
) -> OnlineLocalization | None:
    """Read and index the map; None when the options name no map.

    Raises:
        UserError: There is no map, or it cannot be searched.
        MapError: A file of it is damaged.
    """
    if options.map_folder is None:
        return None
    searched = open_map(
        options.map_folder,
        with_covariances=options.rule.estimates_landmarks,
        feature_type=KINDS[odometry.tracking.descriptor_type].feature_type,
    )
    return OnlineLocalization(searched, device, options, odometry.window)
