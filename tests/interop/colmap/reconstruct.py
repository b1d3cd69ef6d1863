"""Reconstruct images by pycolmap, as a program of its own: IMAGES FOLDER NAME...

Writes `database.db` and the folder `0` with the first model.
"""

import sys
from pathlib import Path

import pycolmap

# of EuRoC's left camera; COLMAP's principal point is half a pixel further
CAMERA = "458.654,457.296,367.715,248.875,-0.28340811,0.07395907,0.00019359,1.76187114e-05"


def main(images: Path, folder: Path, names: list[str]) -> None:
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, reader.camera_params = "OPENCV", CAMERA
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.use_gpu = 1, False
    extraction.sift.max_num_features, extraction.sift.first_octave = 1500, 0
    pycolmap.extract_features(
        folder / "database.db",
        images,
        image_names=names,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
    )
    pycolmap.match_exhaustive(folder / "database.db")
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.ba_refine_focal_length = options.ba_refine_principal_point = False
    options.ba_refine_extra_params = False
    pycolmap.incremental_mapping(folder / "database.db", images, folder, options)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])
