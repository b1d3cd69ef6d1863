"""Opening of the map that the options name."""

from maplab_py.frontend.localization import map_source, online
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.frontend.vertex_keypoints import check_descriptors_exist
from maplab_py.interop.recordings.protocol import RecordedSensors
from maplab_py.vision.features.extractors import KINDS
from maplab_py.vision.features.options import DESCRIPTORS


def opened_localization(
    options: OnlineLocalizationOptions, device: RecordedSensors, odometry: OdometryOptions
) -> online.OnlineLocalization | None:
    """Read and index the map; None when the options name no map.

    Raises:
        UserError: There is no map, or it cannot be searched.
        MapError: A file of it is damaged.
    """
    if options.map_folder is None:
        return None
    tracked = odometry.tracking.descriptor_type
    searched = map_source.open_map(
        options.map_folder,
        with_covariances=options.rule.estimates_landmarks,
        feature_type=KINDS[options.features or tracked].feature_type,
        is_free=not options.features,
    )
    kind, features = searched.database.projection.kind, options.features or tracked
    if not options.features:
        features = next(
            (
                name
                for name in (tracked, *DESCRIPTORS)
                if KINDS[name].feature_type == kind.feature_type
            ),
            tracked,
        )
    else:
        map_source.check_descriptors(searched, kind.size, KINDS[features].feature_type)
    check_descriptors_exist(features)
    return online.OnlineLocalization(searched, device, options, odometry.window, features)
