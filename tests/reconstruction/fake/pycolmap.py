"""Stands in for pycolmap in tests: the same calls, a database of the same tables, a model of cameras in a
row.

`fake.json` beside the database steers it: {"bare": images without features, "lonely": images that match
nothing, "apart": images that end in a second model, "angle": degrees between the rays of any two images, at
most, "unposed": images without a pose, "needs": {image without a pose: the one that it has to be matched with},
"fail": a step that ends the process}. What was done is written to
`calls.txt` there.
"""

import json
import sqlite3
import struct
import sys
from enum import Enum
from pathlib import Path
from types import SimpleNamespace

_TABLES = """CREATE TABLE IF NOT EXISTS images (image_id INTEGER PRIMARY KEY, name TEXT UNIQUE, camera_id INTEGER, w, h);
CREATE TABLE IF NOT EXISTS keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);
CREATE TABLE IF NOT EXISTS descriptors (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);
CREATE TABLE IF NOT EXISTS two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER);"""


Device = Enum("Device", ["auto", "cpu"])
CameraMode = Enum("CameraMode", ["SINGLE"])
FeatureExtractionOptions = lambda: SimpleNamespace(max_image_size=-1, num_threads=-1, sift=SimpleNamespace())  # noqa: E731
ImageReaderOptions = FeatureMatchingOptions = ImportedPairingOptions = SimpleNamespace
TwoViewGeometryOptions = SimpleNamespace
IncrementalPipelineOptions = lambda: SimpleNamespace(  # noqa: E731
    mapper=SimpleNamespace(init_min_tri_angle=16.0, filter_max_reproj_error=4.0, filter_min_tri_angle=1.5)
)
BundleAdjustmentOptions = lambda: SimpleNamespace(ceres=SimpleNamespace(solver_options=SimpleNamespace()))  # noqa: E731
bundle_adjustment = lambda model, options: None  # noqa: E731
ObservationManager = lambda model: SimpleNamespace(filter_all_points3D=lambda error, angle: 0)  # noqa: E731


def set_random_seed(seed):
    assert isinstance(seed, int)


def _plan(database):
    path = Path(database).parent / "fake.json"
    return json.loads(path.read_text()) if path.is_file() else {}


def _told(database, *words):
    with (Path(database).parent / "calls.txt").open("a") as file:
        file.write(" ".join(map(str, words)) + "\n")


def _fail(database, step):
    if _plan(database).get("fail") == step:
        print(f"it broke while {step}", file=sys.stderr)
        sys.exit(9)


class Database:
    def __init__(self, path):
        self.base = sqlite3.connect(path)
        self.base.executescript(_TABLES)

    open = classmethod(lambda cls, path: cls(path))

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.base.commit()
        self.base.close()

    def read_all_images(self):
        rows = self.base.execute("SELECT image_id, name, camera_id FROM images")
        return [SimpleNamespace(image_id=i, name=name, camera_id=c) for i, name, c in rows]

    def exists_keypoints(self, id_):
        return self.base.execute("SELECT 1 FROM keypoints WHERE image_id = ?", (id_,)).fetchone() is not None


def extract_features(
    database, images, *, image_names, camera_mode, reader_options, extraction_options, device
):
    import numpy as np

    from fprf.datamanagers.images import read_header

    assert camera_mode is CameraMode.SINGLE and isinstance(device, Device)
    _told(database, "features", reader_options.camera_model, extraction_options.max_image_size, *image_names)
    bare = _plan(database).get("bare", [])
    with Database.open(database) as base:
        old = max([image.camera_id for image in base.read_all_images()], default=0)
        camera = reader_options.existing_camera_id if reader_options.existing_camera_id > 0 else old + 1
        for k, name in enumerate(image_names):
            if k == len(image_names) // 2 and _plan(database).get("fail") == "features":
                base.base.commit()
                _fail(database, "features")
            header = read_header(Path(images) / name)
            row = (name, camera, header.width, header.height)
            id_ = base.base.execute(
                "INSERT INTO images (name, camera_id, w, h) VALUES (?, ?, ?, ?)", row
            ).lastrowid
            rows = 0 if name in bare else 50
            noise = np.random.default_rng(id_).integers(0, 255, (rows, 128), dtype=np.uint8)
            places = np.ones((rows, 6), np.float32)
            base.base.execute("INSERT INTO keypoints VALUES (?, ?, 6, ?)", (id_, rows, places.tobytes()))
            base.base.execute("INSERT INTO descriptors VALUES (?, ?, 128, ?)", (id_, rows, noise.tobytes()))


def match_image_pairs(database, *, matching_options, pairing_options, verification_options, device):
    _fail(database, "matches")
    pairs = [line.split() for line in Path(pairing_options.match_list_path).read_text().splitlines()]
    _told(database, "matches", len(pairs))
    lonely = {*_plan(database).get("lonely", []), *_plan(database).get("bare", [])}
    with Database.open(database) as base:
        ids = {image.name: image.image_id for image in base.read_all_images()}
        for a, b in pairs:
            low, high = sorted((ids[a], ids[b]))
            count = 0 if {a, b} & lonely else 40
            base.base.execute(
                "INSERT OR IGNORE INTO two_view_geometries VALUES (?, ?)", (low * 2147483647 + high, count)
            )


class _Model:
    def __init__(self, names, sizes):
        self.names = dict(enumerate(sorted(names), 1))
        self.sizes = sizes

    num_reg_images = lambda self: len(self.names)  # noqa: E731
    num_points3D = lambda self: 10 * len(self.names)  # noqa: E731
    reg_image_ids = lambda self: list(self.names)  # noqa: E731
    image = lambda self, id_: SimpleNamespace(name=self.names[id_])  # noqa: E731
    compute_mean_reprojection_error = lambda self: 0.5  # noqa: E731
    compute_mean_track_length = lambda self: 3.0  # noqa: E731
    update_point_3d_errors = lambda self: None  # noqa: E731
    extract_colors_for_all_images = lambda self, folder, threads: None  # noqa: E731

    def write_binary(self, folder):
        folder = Path(folder)
        count = struct.pack("<Q", len(self.names))
        lenses = [
            struct.pack("<IiQQ4d", k, 1, *self.sizes[name], 20, 20, 12, 8) for k, name in self.names.items()
        ]
        (folder / "cameras.bin").write_bytes(count + b"".join(lenses))
        rows = [struct.pack("<Q", len(self.names))]
        for id_, name in self.names.items():
            rows.append(
                struct.pack("<I7dI", id_, 1, 0, 0, 0, -float(id_), 0, 0, id_)
                + name.encode()
                + b"\0"
                + struct.pack("<Q", 0)
            )
        (folder / "images.bin").write_bytes(b"".join(rows))
        points = [struct.pack("<Q3d3BdQ", k, k, k, 9.0, 1, 2, 3, 0.5, 0) for k in range(12)]
        (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(points)) + b"".join(points))


def incremental_mapping(database, images, out, options, *, initial_image_pair_callback, next_image_callback):
    _fail(database, "mapping")
    assert Path(out).is_dir() and options.min_model_size >= 2
    _told(database, "mapping")
    plan = _plan(database)
    with Database.open(database) as base:
        sizes = {name: size for name, *size in base.base.execute("SELECT name, w, h FROM images")}
        ids = {image.name: image.image_id for image in base.read_all_images()}
        matched = {
            divmod(pair, 2147483647)
            for (pair,) in base.base.execute("SELECT pair_id FROM two_view_geometries")
        }
    needing = set()
    for name, partner in plan.get("needs", {}).items():
        if tuple(sorted((ids[name], ids[partner]))) not in matched:
            needing.add(name)
    names = list(sizes)
    lost = {name for key in ("bare", "lonely", "apart", "unposed") for name in plan.get(key, [])}
    main = [name for name in names if name not in lost | needing]
    if plan.get("nothing") or len(main) < 2 or plan.get("angle", 180) < options.mapper.init_min_tri_angle / 4:
        return {}
    initial_image_pair_callback()
    for _ in main[2:]:
        next_image_callback()
    return (
        {0: _Model(plan["apart"], sizes), 1: _Model(main, sizes)}
        if plan.get("apart")
        else {0: _Model(main, sizes)}
    )
