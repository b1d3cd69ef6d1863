"""Accuracy and time of the online front-end: `python -m benchmarks.frontend [FOLDER ...]`.

`strangers` as the first word runs that benchmark. Folders are EuRoC folders with ground truth (run with
all cameras and with the first alone), or maps (replayed, and compared with `optvi` of the recorded map).
Without folders: the shared data.
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path

from benchmarks.frontend import strangers
from benchmarks.frontend.sequences import TRUTH, SequenceResult, run
from tests.support.data import shared_data_folder

COLUMNS = (
    ("sequence", "{}"),
    ("cameras", "{}"),
    ("starts", "{}"),
    ("first_state_s", "{:.2f}"),
    ("distance_m", "{:.1f}"),
    ("ate_m", "{:.4f}"),
    ("ate_final_m", "{:.4f}"),
    ("optvi_ate_m", "{:.4f}"),
    ("median_m", "{:.3f}"),
    ("largest_m", "{:.3f}"),
    ("scale", "{:.4f}"),
    ("cpu_ms", "{:.1f}"),
    ("median_ms", "{:.1f}"),
    ("p99_ms", "{:.1f}"),
)


def main() -> None:
    """Run the sequences and print a table; write JSON if asked to."""
    if sys.argv[1:2] == ["strangers"]:
        strangers.main(sys.argv[2:])
        return
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    shared = shared_data_folder()
    folders = arguments.folders or [
        shared / "euroc_mh01_10s",
        shared / "maplab_maps" / "tango_handheld",
    ]
    sys.stdout.write("".join(f"{name:>15}" for name, _ in COLUMNS) + "\n")
    results: list[SequenceResult] = []
    for folder in folders:
        for cameras in ("", "0") if (folder / TRUTH).exists() else ("",):
            results.append(run(folder, cameras))
            values = dataclasses.asdict(results[-1])
            line = "".join(f"{form.format(values[name]):>15}" for name, form in COLUMNS)
            sys.stdout.write(line + "\n")
            sys.stdout.flush()
    if arguments.json:
        arguments.json.write_text(
            json.dumps([dataclasses.asdict(result) for result in results], indent=1)
        )


if __name__ == "__main__":
    main()
