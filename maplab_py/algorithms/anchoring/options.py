"""Options of anchoring."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.options import option


@dataclasses.dataclass(frozen=True)
class AnchoringOptions:
    """Criteria for the alignment of two missions, with maplab's names."""

    flag_prefix: ClassVar[str] = "anchor_transform_"

    min_inlier_count: int = option(
        4, help="Verified closures between two missions that must agree on one alignment"
    )
    min_inlier_ratio: float = option(
        0.4, help="Ratio of the closures between two missions that must agree"
    )
    ransac_max_orientation_error_rad: float = option(
        0.1, help="Largest difference in yaw of closures that agree", unit="rad"
    )
    ransac_max_position_error_m: float = option(
        1.0, help="Largest difference in position of closures that agree", unit="m"
    )
    add_to_database: bool = option(
        True,
        help="Anchor missions through missions that are anchored by the same command as well",
        flag="add_anchored_missions_to_database",
    )
    hypothesis: int = option(
        0,
        help="Number of an alignment in the report of anchor_all_missions that is to be used, whatever "
        "its evidence; 0 = none",
        flag="anchor_hypothesis",
    )
