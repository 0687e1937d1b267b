"""Check that `gpu.sh` can run here: name packages that cannot be imported; install nothing.

    python benchmarks/gpu_check.py FOLDER

Plug-ins, the built-in ones too, are found by a package's metadata. Where fprf is not installed, FOLDER gets
what an installation would write; with it in PYTHONPATH the checkout works as it is.
"""

import importlib.metadata as metadata
import importlib.util
import sys
import tomllib
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"
NEEDED = ("torch", "numpy", "tyro", "rich", "cv2", "kornia", "trimesh", "safetensors", "numba", "pytest")


def main(folder: Path) -> int:
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        print(
            f"error: {', '.join(missing)} not found; install them, or name their wheels in PYTHONPATH",
            file=sys.stderr,
        )
        return 2
    try:
        metadata.distribution("fprf")
    except metadata.PackageNotFoundError:
        register(folder)
    return 0


def register(folder: Path) -> None:
    project = tomllib.loads(PROJECT.read_text())["project"]
    info = folder / f"{project['name']}-{project['version']}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    lines = []
    for group, points in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in points.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
