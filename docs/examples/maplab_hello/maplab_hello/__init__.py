"""An example plugin: two commands, an importer, a layer of the viewer and a residual for optvi."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.plugin import (
    CommandContext,
    LayerPoints,
    Message,
    Options,
    Report,
    ResidualRows,
    UserError,
    command,
    importer,
    option,
    residual,
    viewer_layer,
)
from maplab_py.vimap import Backbone, BaseFrames, Missions, TransformationEdges, Vertices, VIMap
from maplab_py.vimap.ids import random_ids


class FarLandmarkOptions(Options, prefix="far_"):
    """Each field becomes a flag: --far_distance_m."""

    distance_m: float = option(20.0, gt=0)
    """Landmarks beyond this are far."""


class FarLandmarks(Report):
    """A report: its fields are printed as a table, or as JSON with --json."""

    landmarks: int
    far: int
    largest_distance_m: float


@command("count_far_landmarks", "cfl", example="cfl --far_distance_m=5")
def count_far_landmarks(
    context: CommandContext,
    *,
    options: FarLandmarkOptions = FarLandmarkOptions(),
) -> FarLandmarks:
    """Count the landmarks that are far from the vertex that stores them."""
    distance = np.linalg.norm(context.vi_map.landmarks.p_I, axis=1)
    far = int(np.count_nonzero(distance > options.distance_m))
    return FarLandmarks(len(distance), far, float(distance.max(initial=0.0)))


@command("rename_description", example="rename_description --text='office, second floor'")
def rename_description(context: CommandContext, *, text: str) -> Message:
    """Give the map another description.

    Args:
        text: The new description.
    """
    if not text:
        raise UserError("rename_description: --text is empty")
    vi_map = context.vi_map
    metadata = dataclasses.replace(vi_map.metadata, description=text)
    context.commit(vi_map.replace(metadata=metadata))  # undo brings the old one back
    return Message(f"the map is now described as '{text}'")


@importer("import_positions", example="import_positions walk.csv")
def import_positions(file: Path, *, period_s: float = 1.0) -> VIMap:
    """Make a map of a path: one vertex per row, odometry from each to the next.

    Args:
        file: CSV without a header: x, y and z in metres.
        period_s: Time between two rows.
    """
    try:
        p_M = np.loadtxt(file, delimiter=",", ndmin=2)
    except ValueError as error:
        raise UserError(f"{file}: {error}") from None
    if p_M.shape[1] != 3 or len(p_M) < 2:
        raise UserError(f"{file}: two or more rows of three numbers are expected, not {p_M.shape}")
    count, rng = len(p_M), np.random.default_rng(0)
    no_turn = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))  # x y z w
    steps = np.concatenate([no_turn[1:], np.diff(p_M, axis=0)], axis=1)
    return VIMap(
        missions=Missions.filled(
            1,
            id=random_ids(1, rng),
            baseframe=[0],
            root_vertex=[0],
            backbone=[Backbone.ODOMETRY],
        ),
        baseframes=BaseFrames.filled(1, id=random_ids(1, rng), is_known=[True]),
        vertices=Vertices.filled(
            count,
            id=random_ids(count, rng),
            mission=np.zeros(count, dtype=np.int32),
            T_M_I=np.concatenate([no_turn, p_M], axis=1),
            timestamp_ns=(1e9 * period_s * np.arange(count)).astype(np.int64),
        ),
        transformation_edges=TransformationEdges.filled(
            count - 1,
            id=random_ids(count - 1, rng),
            from_vertex=np.arange(count - 1),
            to_vertex=np.arange(1, count),
            T_A_B=steps,
            covariance=np.tile(1e-4 * np.eye(6), (count - 1, 1, 1)),
        ),
    )


@viewer_layer("far_landmarks", title="Far landmarks", is_visible=False)
def far_landmarks(vi_map: VIMap) -> LayerPoints:
    """Draw the landmarks beyond twenty metres, together with the mission that stores them."""
    landmarks = vi_map.landmarks
    far = np.linalg.norm(landmarks.p_I, axis=1) > FarLandmarkOptions().distance_m
    mission = vi_map.vertices.mission[landmarks.vertex[far]]
    return LayerPoints(vi_map.p_G[far], colours=(220, 60, 40), missions=mission)


@residual("flat_floor", states=("pose",), data_size=1)
def flat_floor(T_G_I: Any, height_m: Any) -> Any:
    """Keep the robot's height above the floor, which is flat."""
    return T_G_I.p[2] - height_m


@flat_floor.rows
def every_vertex(vi_map: VIMap) -> ResidualRows:
    """Give every vertex the usual height, to two centimetres."""
    heights_m = vi_map.T_G_I[:, 6]
    usual = np.full((len(heights_m), 1), np.median(heights_m))
    return ResidualRows(vertices=np.arange(len(heights_m)), data=usual, sigma=0.02)
