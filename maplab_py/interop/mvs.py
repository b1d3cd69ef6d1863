"""Files of programs of multi-view stereo: COLMAP's dense workspace, PMVS, CMVS and Bundler.

Sources: Furukawa and Ponce's documentation of PMVS-2 and CMVS; Snavely's of Bundler v0.3, whose cameras
look along -z with y up.
"""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64, U8
from maplab_py.geometry import se3, so3
from maplab_py.interop.colmap import model as colmap
from maplab_py.interop.colmap.records import binary_files


@dataclasses.dataclass(frozen=True, eq=False)
class MvsScene:
    """Images (V) of perspective cameras (C) and points (L) with observations (O)."""

    size_px: I64  # (C, 2) width and height
    K: F64  # (C, 4) fx, fy, cx, cy [px]; the centre of the first pixel is at 0, 0
    camera: I64  # (V,) rows of cameras
    names: list[str]  # (V,) files of the images
    T_C_G: F64  # (V, 7)
    p_G: F64  # (L, 3)
    colours: U8  # (L, 3) red, green, blue
    landmark: I64  # (O,) rows of points
    view: I64  # (O,) rows of images
    uv_px: F64  # (O, 2)
    error_px: F64  # (L,) mean reprojection error


_FILES = ("cameras.bin", "images.bin", "points3D.bin")
"""Files of a dense workspace; undistorted images are not synchronised, so there are no rigs."""
_PINHOLE = next(model.number for model in colmap.MODELS.values() if model.name == "PINHOLE")


def encode_model(scene: MvsScene) -> dict[str, bytes]:
    """Return the files of a model by their names; every image has its observations in their order."""
    files = binary_files(_model(scene))
    return {name: b"".join(files[name]) for name in _FILES}


def _model(scene: MvsScene) -> colmap.ColmapModel:
    centre = np.array([0.0, 0.0, colmap.PIXEL_CENTRE, colmap.PIXEL_CENTRE])
    cameras = tuple(
        colmap.ColmapCamera(row + 1, _PINHOLE, width, height, scene.K[row] + centre)
        for row, (width, height) in enumerate(scene.size_px.tolist())
    )
    order = np.argsort(scene.view, kind="stable")
    images = colmap.ColmapImages(
        id=_ids(len(scene.names)),
        camera=scene.camera,
        frame=np.zeros_like(scene.camera),
        T_C_W=scene.T_C_G,
        name=tuple(scene.names),
        keypoint_count=np.bincount(scene.view, minlength=len(scene.names)),
        uv=scene.uv_px[order] + colmap.PIXEL_CENTRE,
        point=scene.landmark[order],
    )
    points = colmap.ColmapPoints(_ids(len(scene.p_G)), scene.p_G, scene.colours, scene.error_px)
    none = np.zeros(0, dtype=np.int64)
    frames = colmap.ColmapFrames(none, none, se3.identity(0))
    return colmap.ColmapModel(cameras, (), frames, images, points)


def _ids(count: int) -> I64:
    return np.arange(1, count + 1, dtype=np.int64)


_BUNDLER_AXES = np.diag([1.0, -1.0, -1.0])
_OPTIONS = (
    ("level", 1), ("csize", 2), ("threshold", 0.7), ("wsize", 7), ("minImageNum", 3), ("CPU", 4),
    ("setEdge", 0), ("useBound", 0), ("useVisData", 0), ("sequence", -1), ("maxAngle", 10),
    ("quad", 2.0),
)  # fmt: skip
_DIGITS = 8
"""PMVS numbers its files with eight digits."""


def file_number(view: int) -> str:
    """Return the name, without suffix, of the files of an image."""
    return f"{view:0{_DIGITS}d}"


def projection_text(scene: MvsScene, view: int) -> str:
    """Return the file txt/<number>.txt: the 3 x 4 matrix from G to pixels."""
    fx, fy, cx, cy = scene.K[scene.camera[view]]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    P = K @ se3.to_matrix(scene.T_C_G[view])[:3]
    rows = "\n".join(" ".join(f"{value:.12g}" for value in row) for row in P)
    return f"CONTOUR\n{rows}\n"


def bundler_text(scene: MvsScene) -> str:
    """Return the file bundle.rd.out, from which CMVS makes clusters of images."""
    lines = ["# Bundle file v0.3", f"{len(scene.names)} {len(scene.p_G)}"]
    for view in range(len(scene.names)):
        T_C_G = scene.T_C_G[view]
        R = _BUNDLER_AXES @ so3.to_matrix(T_C_G[:4])
        lines.append(f"{scene.K[scene.camera[view], 0]:.12g} 0 0")
        lines += [_row(row) for row in R]
        lines.append(_row(_BUNDLER_AXES @ T_C_G[4:]))
    order = np.argsort(scene.landmark, kind="stable")
    centre = scene.K[scene.camera[scene.view[order]], 2:]
    from_centre = (scene.uv_px[order] - centre) * np.array([1.0, -1.0])
    within = _number_in_view(scene)[order]
    entries = [
        f"{view} {number} {x:.4f} {y:.4f}"
        for view, number, (x, y) in zip(
            scene.view[order].tolist(), within.tolist(), from_centre.tolist(), strict=True
        )
    ]
    first = np.searchsorted(scene.landmark[order], np.arange(len(scene.p_G) + 1)).tolist()
    for point, (p_G, colour) in enumerate(zip(scene.p_G, scene.colours.tolist(), strict=True)):
        track = entries[first[point] : first[point + 1]]
        lines += [_row(p_G), " ".join(map(str, colour)), " ".join([str(len(track)), *track])]
    return "\n".join(lines) + "\n"


def list_text(names: list[str]) -> str:
    """Return the file list.rd.txt: the images in the order of the Bundler file."""
    return "".join(f"visualize/{name}\n" for name in names)


def option_text(images: int) -> str:
    """Return the file option-all, with which PMVS takes all images."""
    lines = [f"{name} {value}" for name, value in _OPTIONS]
    return "\n".join([*lines, f"timages -1 0 {images}", "oimages 0"]) + "\n"


def _number_in_view(scene: MvsScene) -> I64:
    """Return the number (O,) of each observation within its image."""
    order = np.argsort(scene.view, kind="stable")
    first = np.searchsorted(scene.view[order], np.arange(len(scene.names)))
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order)) - first[scene.view[order]]
    return number


def _row(values: F64) -> str:
    return " ".join(f"{value:.12g}" for value in values)
