"""A day passes over a trained scene: a camera path and keyframes for `fprf render`.

python examples/day.py RUN day
fprf render RUN --path day/path.json --keyframes day/keys.json --output day.webp
"""

import argparse
import itertools
import json
import math
from pathlib import Path

from fprf.light.day import day
from fprf.rendering.paths import spiral, write_camera_path
from fprf.splats.scene import SplatScene
from fprf.training.loading import open_run

SUNS = 17
SLOWEST = 0.3  # time goes the slower the lower the sun stands: at the horizon as by this, overhead as by 1


def write_day(scene: SplatScene, folder: Path, frames: int, fps: float, width: int) -> None:
    """Write path.json (a spiral), keys.json and a style for each sun."""
    folder.mkdir(parents=True, exist_ok=True)
    cameras = spiral(scene.cameras, frames)
    cameras = cameras.scaled(float(cameras.size[0, 0]) / width)
    write_camera_path(folder / "path.json", cameras, fps, scene.origin)
    light = scene.light_found
    hours = day(SUNS, light.noon, clockwise=light.clockwise)
    times = [0.0]
    for before, after in itertools.pairwise(hours):
        height = math.sin(math.radians((before.elevation + after.elevation) / 2))
        times.append(times[-1] + (after.hour - before.hour) / (SLOWEST + max(0.0, height)))
    keys = []
    for hour, time in zip(hours, times, strict=True):
        if hour.config.light is None:
            style = {"sun": [hour.azimuth, hour.elevation]}
        else:
            style = {"light": hour.config.light}
        name = f"{hour.hour:05.2f}.json"
        (folder / name).write_text(json.dumps({"format": 1, "style": style}))
        keys.append({"frame": round(time / times[-1] * (frames - 1)), "style": name})
    (folder / "keys.json").write_text(json.dumps({"format": 1, "keyframes": keys}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=72)
    parser.add_argument("--fps", type=float, default=12.0)
    parser.add_argument("--width", type=int, default=320)
    args = parser.parse_args()
    scene = open_run(args.run, "cpu").scene
    if not isinstance(scene, SplatScene):
        raise SystemExit(
            f"{args.run}: light falls on Gaussians; fprf export {args.run} ply makes some of a field"
        )
    write_day(scene, args.folder, args.frames, args.fps, args.width)


if __name__ == "__main__":
    main()
