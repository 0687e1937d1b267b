"""`python -m fprf.reconstruction.worker JOB.json`: one step of COLMAP, in a process of its own.

pycolmap brings libraries that clash with those of OpenCV and Pillow in one process, so nothing here imports
these, numpy or torch, and nothing else in this package imports pycolmap. Progress goes to standard output as
JSON lines, COLMAP's own words to standard error. Exit codes: 0 done, 3 pycolmap is absent or too old, 4 no
reconstruction; anything else is COLMAP's failure.
"""

import itertools
import json
import sys
from pathlib import Path
from typing import Any

NO_PYCOLMAP = 3
NO_MODEL = 4
_FIRST_ANGLES = 16.0, 2.0
"""Degrees between the rays of the first pair, at least; COLMAP itself goes down to a quarter. Where all
photographs face the same things from nearly one place (llff_flower: 34 within an arm's length) none has more
than four.
"""


def main(job: dict[str, Any]) -> int:
    """Run a job: `step` is features, matches or mapping."""
    try:
        import pycolmap

        # Another seed finds other points; the options looked up here are absent before pycolmap 4.
        steps = {"features": _features, "matches": _matches, "mapping": _mapping}
        pycolmap.set_random_seed(job["seed"])
        pycolmap.FeatureExtractionOptions, pycolmap.ImportedPairingOptions  # noqa: B018
    except (ImportError, AttributeError) as error:
        print(f"pycolmap: {error}", file=sys.stderr)
        return NO_PYCOLMAP
    return steps[job["step"]](pycolmap, job)


def _features(pycolmap: Any, job: dict[str, Any]) -> int:
    """Features of the images that have none yet; images of a group share a camera."""
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = job["side"]
    options.num_threads = job["threads"]
    options.sift.max_num_features = job["features"]
    for group in job["groups"]:
        # Images of the group without features; the camera is that of those that have some, or a new one (-1).
        missing = []
        camera = -1
        with pycolmap.Database.open(job["database"]) as base:
            images = {image.name: image for image in base.read_all_images()}
            for name in group:
                image = images.get(name)
                camera = camera if image is None else image.camera_id
                if image is None or not base.exists_keypoints(image.image_id):
                    missing.append(name)
        if not missing:
            continue
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = job["lens"]
        reader.existing_camera_id = camera
        pycolmap.extract_features(
            job["database"],
            job["images"],
            image_names=missing,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu if job["cpu"] else pycolmap.Device.auto,
        )
    return 0


def _matches(pycolmap: Any, job: dict[str, Any]) -> int:
    """Matches of listed pairs, verified by geometry; pairs that were matched before are left as they are."""
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = job["threads"]
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = job["pairs"]
    verification = pycolmap.TwoViewGeometryOptions()
    pycolmap.match_image_pairs(
        job["database"],
        matching_options=options,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu if job["cpu"] else pycolmap.Device.auto,
    )
    return 0


def _mapping(pycolmap: Any, job: dict[str, Any]) -> int:
    """Poses and points; every model is described in models.json, the largest one is written."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = job["threads"]
    options.random_seed = job["seed"]
    options.min_model_size = 3
    registered = itertools.count(1)

    def count() -> None:
        print(json.dumps({"registered": next(registered)}), flush=True)

    # COLMAP calls back for the first pair and for every image after it.
    out = Path(job["models"])
    out.mkdir(parents=True, exist_ok=True)
    mapped = {}
    for angle in _FIRST_ANGLES:
        options.mapper.init_min_tri_angle = angle
        mapped = pycolmap.incremental_mapping(
            job["database"],
            job["images"],
            str(out),
            options,
            initial_image_pair_callback=count,
            next_image_callback=count,
        )
        if mapped:
            break
    models = sorted(mapped.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    described = []
    for model in models:
        described.append(
            {
                "images": sorted(model.image(id_).name for id_ in model.reg_image_ids()),
                "points": model.num_points3D(),
                "error_pixels": model.compute_mean_reprojection_error(),
                "track_length": model.compute_mean_track_length(),
            }
        )
    if models:
        best = out / "best"
        best.mkdir(exist_ok=True)
        models[0].write_binary(str(best))
    (out / "models.json").write_text(json.dumps(described), encoding="utf-8")
    return 0 if models else NO_MODEL


if __name__ == "__main__":
    sys.exit(main(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))))
