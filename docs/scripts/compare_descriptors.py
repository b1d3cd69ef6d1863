"""Draw docs/images/descriptor_distances.svg: simulated descriptors beside those of recorded maps.

python docs/scripts/compare_descriptors.py RECORDED_MAP_FOLDER...

Distances are in bits of 384. "same" are pairs of observations of one landmark, "different" pairs of
observations of two landmarks. The overlap of two histograms is the area that they share, in percent.
"""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.storage.native import load_map
from maplab_py.vimap import VIMap

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

TARGET = Path(__file__).resolve().parents[1] / "images" / "descriptor_distances.svg"
WIDTH, HEIGHT, LEFT, TOP = 640, 300, 54, 40
BITS, STEP_BITS, PAIRS = 384, 6, 400_000
BINS = np.arange(0, 300 + STEP_BITS, STEP_BITS)
COLOURS = {"same": "#0b6fb8", "different": "#c8501e"}


def distances(maps: list[VIMap], points: list[I64] | None = None) -> dict[str, I64]:
    """Return distances of pairs that show the same landmark, and of pairs that do not.

    Args:
        maps: Maps whose descriptors are compared, each within itself.
        points: What the landmarks of each map show, where it is known; else different landmarks
            count as different points.
    """
    rng = np.random.default_rng(0)
    found: dict[str, list[I64]] = {"same": [], "different": []}
    for number, vi_map in enumerate(maps):
        rows = vi_map.observations
        if not (vi_map.binary_descriptor_size[rows] > 0).all():
            raise SystemExit("the map has observations without a binary descriptor")
        landmark = vi_map.keypoints.landmark[rows].astype(np.int64)
        point = landmark if points is None else points[number][landmark]
        descriptor = vi_map.keypoints.descriptor[rows]
        start = vi_map.observation_start
        share = PAIRS // len(maps)
        one = rng.integers(0, len(rows), share)
        low, high = start[landmark[one]], start[landmark[one] + 1]
        other = low + np.floor(rng.uniform(size=share) * (high - low)).astype(np.int64)
        stranger = rng.integers(0, len(rows), share)
        for kind, second, fits in (
            ("same", other, other != one),
            ("different", stranger, point[stranger] != point[one]),
        ):
            pairs = descriptor[one[fits]] ^ descriptor[second[fits]]
            found[kind].append(np.bitwise_count(pairs).sum(axis=1, dtype=np.int64))
    return {kind: np.concatenate(parts) for kind, parts in found.items()}


def histogram(values: I64) -> F64:
    """Return the share of values in each bin; what lies beyond the last bin is in it."""
    counts = np.histogram(np.minimum(values, BINS[-1] - 1), BINS)[0]
    return np.asarray(counts / counts.sum())


def overlap(one: F64, other: F64) -> float:
    """Return the area that two histograms share, 1 = they are equal."""
    return float(np.minimum(one, other).sum())


def recorded_distances(folders: list[Path]) -> dict[str, I64]:
    """Return the distances within recorded maps."""
    return distances([load_map(folder)[0] for folder in folders])


def simulated_distances() -> dict[str, I64]:
    """Return the distances within the sessions of the scenario of `demo`."""
    data = simulate(load_scenario("three_sessions"))
    points, first = [], 0
    for vi_map in data.maps:
        last = first + len(vi_map.landmarks)
        points.append(data.truth.landmark_point[first:last])
        first = last
    return distances(data.maps, points)


def _outline(shares: F64, highest: float) -> str:
    x = LEFT + np.repeat(BINS, 2)[1:-1] / BINS[-1] * (WIDTH - LEFT - 20)
    y = TOP + (1.0 - np.repeat(shares, 2) / highest) * (HEIGHT - TOP - 44)
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))


def drawing(recorded: dict[str, I64], simulated: dict[str, I64]) -> str:
    """Return the figure as SVG."""
    shares = {
        (source, kind): histogram(values[kind])
        for source, values in (("recorded", recorded), ("simulated", simulated))
        for kind in COLOURS
    }
    highest = max(float(values.max()) for values in shares.values())
    base = HEIGHT - 44
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" '
        'font-family="sans-serif" font-size="12">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
        f'<text x="{LEFT}" y="20">filled: recorded maps, line: simulated</text>',
    ]
    for kind, colour in COLOURS.items():
        area = _outline(shares["recorded", kind], highest)
        right = WIDTH - 20
        lines.append(
            f'<polygon points="{LEFT},{base} {area} {right},{base}" fill="{colour}" '
            'fill-opacity="0.25"/>'
        )
        lines.append(
            f'<polyline points="{_outline(shares["simulated", kind], highest)}" fill="none" '
            f'stroke="{colour}" stroke-width="2"/>'
        )
        common = 100.0 * overlap(shares["recorded", kind], shares["simulated", kind])
        x, anchor = (LEFT + 130, "start") if kind == "same" else (WIDTH - 20, "end")
        lines.append(
            f'<text x="{x}" y="{TOP}" text-anchor="{anchor}" fill="{colour}">{kind} landmark: {common:.0f} % '
            "overlap</text>"
        )
    lines.append(f'<line x1="{LEFT}" y1="{base}" x2="{WIDTH - 20}" y2="{base}" stroke="black"/>')
    for bits in range(0, 301, 50):
        x = LEFT + bits / BINS[-1] * (WIDTH - LEFT - 20)
        lines.append(f'<text x="{x:.1f}" y="{base + 16}" text-anchor="middle">{bits}</text>')
    middle = LEFT + 0.5 * (WIDTH - LEFT - 20)
    lines.append(
        f'<text x="{middle}" y="{HEIGHT - 8}" text-anchor="middle">Hamming distance [bits of '
        f"{BITS}]</text>"
    )
    return "\n".join([*lines, "</svg>", ""])


def main(folders: list[Path]) -> None:
    """Compare, draw, and print the numbers."""
    recorded, simulated = recorded_distances(folders), simulated_distances()
    TARGET.write_text(drawing(recorded, simulated), encoding="utf-8")
    for kind in COLOURS:
        for name, values in (("recorded", recorded[kind]), ("simulated", simulated[kind])):
            quantiles = np.percentile(values, [1, 5, 25, 50, 75, 95, 99])
            print(kind, name, *(f"{value:.0f}" for value in quantiles))  # noqa: T201
        common = overlap(histogram(recorded[kind]), histogram(simulated[kind]))
        print(kind, f"overlap {common:.3f}")  # noqa: T201


if __name__ == "__main__":
    main([Path(argument) for argument in sys.argv[1:]])
