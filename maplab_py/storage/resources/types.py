"""The resource types of the format: number, folder name, file suffix."""

import dataclasses

from maplab_py.errors import MapError, UserError


@dataclasses.dataclass(frozen=True)
class ResourceType:
    """One type of resource."""

    number: int
    name: str  # of the folder below `resources`
    suffix: str


_NAMES = (
    ("raw_images", ".pgm"),
    ("undistorted_images", ".pgm"),
    ("rectified images", ".pgm"),
    ("depth_map_images", ".pgm"),
    ("raw_color_images", ".ppm"),
    ("undistorted_color_images", ".ppm"),
    ("rectified_color_images", ".ppm"),
    ("depth_map_color_image", ".ppm"),
    ("raw_depth_maps", ".pgm"),
    ("optimized_depth_maps", ".pgm"),
    ("disparity_maps", ".pgm"),
    ("text", ".txt"),
    ("pmvs_reconstruction_paths", ".txt"),
    ("tsdf_grid_paths", ".txt"),
    ("esdf_grid_paths", ".txt"),
    ("occupancy_grid_paths", ".txt"),
    ("point_cloud", ".ply"),
    ("color_point_cloud", ".ply"),
    ("voxblox_tsdf_map", ".tsdf.voxblox"),
    ("voxblox_esdf_map", ".esdf.voxblox"),
    ("voxblox_occupancy_map", ".occupancy.voxblox"),
    ("point_cloud_w_intensity", ".ply"),
    ("object_instance_bounding_boxes", ".obj_instance_bboxes.proto"),
    ("object_instance_masks", ".obj_instance_mask.ppm"),
    ("labeled_point_cloud", ".ply"),
)

RESOURCE_TYPES = tuple(ResourceType(number, *names) for number, names in enumerate(_NAMES))


def resource_type(number: int) -> ResourceType:
    """Return the type with this number.

    Raises:
        MapError: The format has no such type.
    """
    if not 0 <= number < len(RESOURCE_TYPES):
        raise MapError(f"resource type {number} is unknown: the format has 0 to {len(_NAMES) - 1}")
    return RESOURCE_TYPES[number]


def resource_type_of(text: str, flag: str = "--resource_type") -> ResourceType:
    """Return the type that a user names by its number or its folder, such as 8 or raw_depth_maps.

    Raises:
        UserError: The format has no such type; the message lists the types.
    """
    for kind in RESOURCE_TYPES:
        if text.strip() in (str(kind.number), kind.name):
            return kind
    known = ", ".join(f"{kind.number} {kind.name}" for kind in RESOURCE_TYPES)
    raise UserError(f"{flag}={text}: there is no such resource type; choose one of {known}")
