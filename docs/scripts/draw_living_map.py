"""Draw docs/images/living_map.png: a map of a changing floor after sessions 1, 10, 20 and 30.

python docs/scripts/draw_living_map.py
"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np

from maplab_py.algorithms.landmarks.evidence import read_evidence, session_times_s
from maplab_py.algorithms.landmarks.persistence import PersistenceOptions, existence
from maplab_py.algorithms.localization.localization import align_robustly
from maplab_py.algorithms.map_update import chronicle
from maplab_py.algorithms.map_update.options import UpdateOptions
from maplab_py.algorithms.map_update.update import prepare_session, update_map
from maplab_py.array_types import F64, U8
from maplab_py.geometry import se3
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import SessionSimulator
from maplab_py.viewer import colours
from maplab_py.vimap import VIMap

TARGET = Path(__file__).resolve().parents[1] / "images" / "living_map.png"
SHOWN = (1, 10, 20, 30)
BUDGET_SESSIONS = 3
PX_PER_M, MARGIN_M, TITLE_PX = 40, 0.4, 30
GROUND, FURNITURE, INK = (250, 250, 250), (222, 222, 222), (60, 60, 60)


def panel(vi_map: VIMap, T_W_G: F64, boxes: F64, bounds: F64, title: str) -> U8:
    """Return a map from above: good landmarks by the probability that they exist, and the furniture."""
    low, high = bounds[0, :2] - MARGIN_M, bounds[1, :2] + MARGIN_M
    width, height = (int(size) for size in PX_PER_M * (high - low))
    picture = np.full((height + TITLE_PX, width, 3), GROUND, dtype=np.uint8)

    def pixels(p: F64) -> np.ndarray:
        x, y = p[..., 0] - low[0], high[1] - p[..., 1]
        return np.stack([PX_PER_M * x, PX_PER_M * y + TITLE_PX], axis=-1).astype(np.int32)

    for first, second in pixels(boxes).tolist():
        cv2.rectangle(picture, first, second, FURNITURE, cv2.FILLED)
    now = float(session_times_s(vi_map).max())
    exists = existence(read_evidence(vi_map), PersistenceOptions(), at_s=now)
    good = np.flatnonzero(vi_map.landmarks.quality == 2)
    colour = colours.ramp(exists[good], colours.TRUST)
    for place, tint in zip(
        pixels(se3.transform(T_W_G, vi_map.p_G[good])).tolist(), colour.tolist(), strict=True
    ):
        cv2.circle(picture, place, 3, tint, cv2.FILLED, cv2.LINE_AA)
    cv2.putText(
        picture, title, (12, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, INK, 1, cv2.LINE_AA
    )  # fmt: skip
    return picture


def main() -> None:
    """Update a map with all sessions of `office_year`, draw it four times, and print each record."""
    simulator = SessionSimulator(load_scenario("office_year"))
    world = simulator.world
    assert world.has_box is not None
    options, panels = UpdateOptions(), []
    for number in range(SHOWN[-1]):
        session = simulator.session(number)
        if number == 0:
            vi_map = prepare_session(session.vi_map)
            known = vi_map.baseframes.replace(is_known=np.ones(1, dtype=np.bool_))
            vi_map = vi_map.replace(baseframes=known)
        else:
            vi_map, _ = update_map(vi_map, session.vi_map, options)
            record = chronicle.records(vi_map, None)[-1]
            facts = vars(record.facts[-1]) | {"stored_kb": round(1e-3 * len(record.differences), 1)}
            sys.stdout.write(json.dumps({"number": number + 1} | facts) + "\n")
        if number == BUDGET_SESSIONS - 1:
            good = int(np.count_nonzero(vi_map.landmarks.quality == 2))
            options = UpdateOptions(max_landmarks=good, max_vertices=len(vi_map.vertices))
        if number + 1 in SHOWN:
            rows = vi_map.vertex_index.rows(session.truth.vertex_id)
            T_W_G = align_robustly(
                session.truth.T_G_I[rows >= 0, 4:], vi_map.T_G_I[rows[rows >= 0], 4:], level=True
            )
            sizes = f"{len(vi_map.landmarks)} landmarks, {len(vi_map.vertices)} vertices"
            title = f"session {number + 1}: {sizes}"
            boxes = world.boxes[world.has_box[number]][:, :, :2]
            panels.append(panel(vi_map, T_W_G, boxes, world.bounds, title))
    picture = cv2.cvtColor(np.concatenate(panels), cv2.COLOR_RGB2BGR)
    cv2.imwrite(str(TARGET), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
