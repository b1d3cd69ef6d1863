"""The map in which a recording is localised, from a folder or a summary map."""

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.algorithms.landmarks.quality import evaluate_unknown_quality
from maplab_py.algorithms.localization.database import (
    LocalizationMap,
    database_of_map,
    database_of_summary,
    features_of_good_landmarks,
)
from maplab_py.algorithms.loop_closure.features import map_features
from maplab_py.algorithms.summary.summary import landmark_covariances
from maplab_py.array_types import F64
from maplab_py.errors import MaplabError, UserError
from maplab_py.interop.recordings.protocol import RecordedSensors
from maplab_py.sensors import CameraRig, SensorSet
from maplab_py.storage.native import is_map_folder, load_map
from maplab_py.storage.summary_map import SummaryMap, read_summary_map, summary_map_file
from maplab_py.vimap import VIMap, descriptors
from maplab_py.vision.features import extractors, options

_FLAG = "--vio_localization_map_folder"
_SMALLEST_SIGMA_M = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class SearchedMap:
    """A map to localise in."""

    name: str
    database: LocalizationMap
    covariance_G: F64 | None  # (L, 3, 3) of the landmarks [m^2]; None = not known
    sensors: SensorSet | None = None  # of those who made the map


def open_map(
    path: Path,
    *,
    with_covariances: bool = False,
    feature_type: int = descriptors.FeatureType.BINARY,
    is_free: bool = False,
) -> SearchedMap:
    """Read a map folder or a summary map.

    Args:
        path: Folder of a map, or a summary map or its folder.
        with_covariances: The landmarks' covariances are wanted.
        feature_type: Type of the recording's descriptors.
        is_free: Where the map has none of that type, another one that images can be described by will do.

    Raises:
        UserError: There is no map, it cannot be searched, or it has no covariances.
        MapError: A file of it is damaged.
    """
    if is_map_folder(path):
        vi_map, _ = load_map(path)
        there = descriptors.types_of(vi_map.frames)
        if is_free and feature_type not in there:
            others = (extractors.KINDS[name].feature_type for name in options.DESCRIPTORS)
            feature_type = next((each for each in others if each in there), feature_type)
        return of_map(
            vi_map, str(path), with_covariances=with_covariances, feature_type=feature_type
        )
    if summary_map_file(path) is not None:
        return of_summary(read_summary_map(path), str(path), with_covariances=with_covariances)
    raise UserError(f"{_FLAG}={path} is neither a map folder nor a summary map")


def of_map(
    vi_map: VIMap,
    name: str,
    *,
    with_covariances: bool = False,
    feature_type: int = descriptors.FeatureType.BINARY,
) -> SearchedMap:
    """Take a map in memory; see `open_map`."""
    types = descriptors.types_of(vi_map.frames)
    if types and feature_type not in types:
        raise UserError(_wrong_type(name, sorted(types), feature_type))
    try:
        database = database_of_map(vi_map, feature_type=feature_type)
    except MaplabError as error:
        raise UserError(f"{name}: {error}") from error
    covariance = None
    if with_covariances:
        judged, _ = evaluate_unknown_quality(vi_map)
        missions = np.arange(len(judged.missions))
        features, _ = map_features(
            judged, missions, projection=database.projection, feature_type=feature_type
        )
        rows = features_of_good_landmarks(judged, features)
        landmarks = np.unique(features.descriptors.label[rows])
        covariance = landmark_covariances(judged, features)[landmarks]
    return _checked(SearchedMap(name, database, covariance, vi_map.sensors))


def of_summary(summary: SummaryMap, name: str, *, with_covariances: bool = False) -> SearchedMap:
    """Take a summary map in memory; see `open_map`."""
    try:
        database = database_of_summary(summary)
    except MaplabError as error:
        raise UserError(f"{name}: {error}") from error
    covariance = None
    if with_covariances:
        if summary.landmark_covariance is None:
            raise UserError(
                f"{name}: the summary map has no covariances: give --vil_landmark_uncertainty=none"
            )
        covariance = summary.landmark_covariance.astype(np.float64)
    return _checked(SearchedMap(name, database, covariance, summary.sensors))


def _wrong_type(name: str, types: list[int], feature_type: int) -> str:
    """Return why a map cannot be searched with descriptors of a type, and the remedy."""
    wanted = descriptors.type_name(feature_type)
    remedy = f"choose a map with {wanted} descriptors"
    for word in options.DESCRIPTORS:
        if extractors.KINDS[word].feature_type in types:
            remedy += f", or give --vio_localization_features={word}"
    there = ", ".join(descriptors.type_name(kind) for kind in types)
    return f"{name}: its descriptors are {there}, those of the recording {wanted}: {remedy}"


def check_descriptors(searched: SearchedMap, size: int, feature_type: int) -> None:
    """Check that descriptors of this many bytes and this type can be matched.

    Raises:
        UserError: The map has descriptors of another size or type.
    """
    kind = searched.database.projection.kind
    wanted = kind.size
    if kind.feature_type != feature_type:
        raise UserError(_wrong_type(searched.name, [kind.feature_type], feature_type))
    if size != wanted:
        raise UserError(
            f"{searched.name}: its descriptors have {wanted} bytes, those of the recording {size}: "
            "make the map from recordings with the same descriptors"
        )


def calibration_notes(searched: SearchedMap, device: RecordedSensors) -> list[str]:
    """Return a note on every camera that the map knows with another calibration."""
    if searched.sensors is None:
        return []
    cameras = {
        camera.id: camera
        for sensor in searched.sensors.sensors.values()
        if isinstance(sensor, CameraRig)
        for camera in sensor.cameras
    }
    return [
        f"camera {camera.id} has another calibration in the map {searched.name}: poses in the map "
        "will be off"
        for camera in device.cameras
        if camera.id in cameras and not _agree(camera, cameras[camera.id])
    ]


def _agree(a: object, b: object) -> bool:
    names = ("intrinsics", "distortion_parameters")
    values = [[np.asarray(getattr(x, name)) for name in names] for x in (a, b)]
    return all(
        x.shape == y.shape and np.allclose(x, y, rtol=1e-3, atol=1e-4)
        for x, y in zip(*values, strict=True)
    )


def _checked(searched: SearchedMap) -> SearchedMap:
    """Check that all numbers are finite; bound covariances from below.

    Raises:
        UserError: A position or a descriptor is not a finite number.
    """
    database = searched.database
    for what, values in (
        ("landmark positions", database.p_G),
        ("descriptors", database.descriptors.projected),
        ("observer positions", database.p_G_observer),
        ("landmark covariances", searched.covariance_G),
    ):
        if values is not None and not np.isfinite(values).all():
            raise UserError(f"{searched.name}: {what} are not all finite: make the map again")
    if searched.covariance_G is None:
        return searched
    floor = _SMALLEST_SIGMA_M**2 * np.eye(3)
    symmetric = 0.5 * (searched.covariance_G + searched.covariance_G.transpose(0, 2, 1))
    return dataclasses.replace(searched, covariance_G=symmetric + floor)
