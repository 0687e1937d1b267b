"""`python -m fprf.reconstruction.worker JOB.json`: one step of COLMAP, in a process of its own.

pycolmap brings libraries that clash with those of OpenCV and Pillow in one process, so nothing here imports
these, numpy or torch, and nothing else in this package imports pycolmap. Progress goes to standard output as
JSON lines, COLMAP's own words to standard error. Exit codes: 0 done, 3 pycolmap is absent or too old, 4 no
reconstruction; anything else is COLMAP's failure.
"""

import itertools
import json
import shutil
import statistics
import sys
from pathlib import Path
from typing import Any

NO_PYCOLMAP = 3
"""Exit code: pycolmap is absent or too old."""
NO_MODEL = 4
"""Exit code: no two images fit together."""
_POINTS_OF_IMAGE = 300
"""Points of an image that lenses are told apart by: a hundred images take seconds, and focal lengths come out
within 2 %."""
_MAX_LENS_RATIO = 10.0
"""Ratio of the longest and the shortest lens of a capture: phones have 13 to 120 mm."""
_MAX_LENS_ITERATIONS = 50
"""Rounds of bundle adjustment that lenses are told apart by: two lenses by 30 % take 20. By eye."""
_LENS_TOLERANCE = 1e-6
"""Relative fall of the cost below which the adjustment ends; COLMAP's own 0 takes all rounds."""
_MIN_MODEL_IMAGES = 3
"""Images of a reconstruction, at least: fewer are no scene."""
_FIRST_ANGLES = (16.0, 2.0)
"""Degrees between the rays of the first pair, at least; COLMAP itself goes down to a quarter. Where all
photographs face the same things from nearly one place (llff_flower: 34 within an arm's length) none has more
than four.
"""
_GLOBAL_ADJUSTMENT_RATIO = 1.4
"""Growth of images or points after which all poses are adjusted together; COLMAP's own 1.1 takes 128 instead of 89
CPU seconds for 55 photographs, and ends at the same error (benchmarks/results/process.json).
"""
_ADJUSTMENT_TOLERANCE = 1e-5
"""Relative fall of the cost below which an adjustment ends while images are added; COLMAP's own 0 takes all rounds."""
_GLOBAL_REFINEMENTS = 3
"""Adjustments of all poses one after the other, each without the points that the one before found wrong; COLMAP's
own 5, at tolerance 1e-6, take 41 instead of 22 seconds for 55 photographs."""
_LAST_ADJUSTMENTS = 3
"""Adjustments of the finished model without a tolerance: they bring the error from 1.037 to 1.027 pixels, below
the 1.031 of COLMAP's own settings, in 5 seconds."""


def main(job: dict[str, Any]) -> int:
    """Run a job: `step` is features, matches, mapping or lenses."""
    try:
        import pycolmap

        # Another seed finds other points; the options looked up here are absent before pycolmap 4.
        steps = {"features": _features, "matches": _matches, "mapping": _mapping, "lenses": _lenses}
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
                if image is None:
                    camera = camera
                else:
                    camera = image.camera_id
                if image is None or not base.exists_keypoints(image.image_id):
                    missing.append(name)
        if not missing:
            continue
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = job["lens"]
        reader.existing_camera_id = camera
        if job["masks"]:
            reader.mask_path = job["masks"]
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
    options.min_model_size = _MIN_MODEL_IMAGES
    # A focal length that no file says drifts between adjustments of all poses (m360_bonsai at 480x320).
    if job["focal_known"]:
        options.ba_global_frames_ratio = _GLOBAL_ADJUSTMENT_RATIO
        options.ba_global_points_ratio = _GLOBAL_ADJUSTMENT_RATIO
        options.ba_global_max_refinements = _GLOBAL_REFINEMENTS
    options.ba_local_function_tolerance = _ADJUSTMENT_TOLERANCE
    options.ba_global_function_tolerance = _ADJUSTMENT_TOLERANCE
    options.extract_colors = False
    registered = itertools.count(1)

    def count() -> None:
        print(json.dumps({"registered": next(registered)}), flush=True)

    out = Path(job["models"])
    out.mkdir(parents=True, exist_ok=True)
    database = job["database"]
    if job["lenses"]:
        database = str(out / "database.db")
        shutil.copyfile(job["database"], database)
        _regroup(pycolmap, database, job["lenses"], job["focal"])
    # COLMAP calls back for the first pair and for every image after it.
    mapped = {}
    for angle in _FIRST_ANGLES:
        options.mapper.init_min_tri_angle = angle
        mapped = pycolmap.incremental_mapping(
            database,
            job["images"],
            str(out),
            options,
            initial_image_pair_callback=count,
            next_image_callback=count,
        )
        if mapped:
            break
    found = list(mapped.values())
    if job["lenses"]:
        found = [model for model in found if _has_true_lenses(model)]
    models = sorted(found, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    if models:
        _finish(pycolmap, models[0], options, job)
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
    # Lenses are tried beside a model that is there: none is an answer.
    if job["lenses"]:
        Path(database).unlink()
        return 0
    return 0 if models else NO_MODEL


def _finish(pycolmap: Any, model: Any, mapping: Any, job: dict[str, Any]) -> None:
    """Adjust a model to the end, drop what does not fit as the mapping does, and give its points colours."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = job["threads"]
    for _ in range(_LAST_ADJUSTMENTS):
        pycolmap.bundle_adjustment(model, options)
        manager = pycolmap.ObservationManager(model)
        manager.filter_all_points3D(
            mapping.mapper.filter_max_reproj_error, mapping.mapper.filter_min_tri_angle
        )
        model.update_point_3d_errors()
    # All at the end: COLMAP's mapping decodes one image after the other.
    model.extract_colors_for_all_images(job["images"], job["threads"])


def _has_true_lenses(model: Any) -> bool:
    """True where all focal lengths could be those of lenses on one walk."""
    focal = []
    for camera in model.cameras.values():
        focal.append(camera.mean_focal_length())
    return bool(min(focal) > 0 and max(focal) < _MAX_LENS_RATIO * min(focal))


def _regroup(pycolmap: Any, database: str, lenses: dict[str, str], focal: dict[str, float]) -> None:
    """Give each lens a camera of its own in a database, beginning with the focal length where one is known."""
    with pycolmap.Database.open(database) as base:
        frame_of = {}
        for frame in base.read_all_frames():
            for data in frame.data_ids:
                frame_of[data.id] = frame
        sensors: dict[str, tuple[Any, int]] = {}
        for image in base.read_all_images():
            lens = lenses.get(image.name)
            if lens is None:
                continue
            if lens not in sensors:
                camera = _copied(pycolmap, base.read_camera(image.camera_id), focal.get(lens))
                sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, base.write_camera(camera))
                rig = pycolmap.Rig()
                rig.add_ref_sensor(sensor)
                sensors[lens] = (sensor, base.write_rig(rig))
            # The frame goes first: an image is checked against it.
            sensor, rig_number = sensors[lens]
            frame = pycolmap.Frame()
            frame.frame_id = frame_of[image.image_id].frame_id
            frame.rig_id = rig_number
            frame.add_data_id(pycolmap.data_t(sensor, image.image_id))
            base.update_frame(frame)
            image.camera_id = sensor.id
            base.update_image(image)


def _copied(pycolmap: Any, camera: Any, focal: float | None) -> Any:
    """A camera like another, without a number, with another focal length where one is given."""
    params = list(camera.params)
    if focal is not None:
        for index in camera.focal_length_idxs():
            params[index] = focal
    return pycolmap.Camera(model=camera.model, width=camera.width, height=camera.height, params=params)


def _lenses(pycolmap: Any, job: dict[str, Any]) -> int:
    """Adjust a model with each of some groupings of its images by lens: error and focal lengths of each."""
    model = pycolmap.Reconstruction(job["model"])
    points = _sampled_points(model)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.max_num_iterations = _MAX_LENS_ITERATIONS
    options.ceres.solver_options.function_tolerance = _LENS_TOLERANCE
    options.ceres.solver_options.num_threads = job["threads"]
    results = []
    for lenses in job["groupings"]:
        grouped = _with_lenses(pycolmap, model, points, lenses)
        pycolmap.bundle_adjustment(grouped, options)
        grouped.update_point_3d_errors()
        focal = {}
        for image in grouped.images.values():
            focal[image.name] = grouped.cameras[image.camera_id].mean_focal_length()
        results.append({"error": grouped.compute_mean_reprojection_error(), "focal": focal})
        print(json.dumps({"solved": len(results)}), flush=True)
    Path(job["result"]).write_text(json.dumps(results), encoding="utf-8")
    return 0


def _sampled_points(model: Any) -> list[int]:
    """Numbers of points that many images see, so many that each image sees enough of them."""
    seen = dict.fromkeys(model.images, 0)
    chosen = []
    for number, point in sorted(model.points3D.items(), key=lambda item: -item[1].track.length()):
        images = set()
        for element in point.track.elements:
            images.add(element.image_id)
        if any(seen[image] < _POINTS_OF_IMAGE for image in images):
            chosen.append(number)
            for image in images:
                seen[image] += 1
    return chosen


def _with_lenses(pycolmap: Any, model: Any, points: list[int], lenses: dict[str, str]) -> Any:
    """A copy of a model with some of its points, and a camera for each lens, of the median focal length."""
    posed = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    focal: dict[str, list[float]] = {}
    for image in posed:
        focal.setdefault(lenses[image.name], []).append(model.cameras[image.camera_id].mean_focal_length())
    grouped = pycolmap.Reconstruction()
    cameras: dict[str, int] = {}
    for image in posed:
        lens = lenses[image.name]
        if lens not in cameras:
            middle = statistics.median(focal[lens])
            camera = _copied(pycolmap, model.cameras[image.camera_id], middle)
            camera.camera_id = len(cameras) + 1
            grouped.add_camera_with_trivial_rig(camera)
            cameras[lens] = camera.camera_id
        places = pycolmap.Point2DList([pycolmap.Point2D(place.xy) for place in image.points2D])
        copy = pycolmap.Image(
            name=image.name, camera_id=cameras[lens], image_id=image.image_id, points2D=places
        )
        grouped.add_image_with_trivial_frame(copy, image.cam_from_world())
    for number in points:
        point = model.points3D[number]
        grouped.add_point3D(point.xyz, point.track, point.color)
    return grouped


if __name__ == "__main__":
    sys.exit(main(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))))
