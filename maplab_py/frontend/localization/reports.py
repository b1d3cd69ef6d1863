"""Localisation in a map, as part of a report."""

import dataclasses
from pathlib import Path


@dataclasses.dataclass(frozen=True)
class LocalizationSummary:
    """Quality of the localisation of a recording."""

    map_name: str
    mode: str
    map_landmarks: int
    localized_share: float  # of all frames
    first_localized_s: float | None  # after the first frame; None = never
    queries: int
    answers_by_index: int
    answers_by_tracking: int
    matches: int
    starts: int  # of T_G_M
    disagreeing: int
    late: int
    refused: dict[str, int]  # answers of the index, by reason
    csv_file: Path | None
