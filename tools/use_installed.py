"""Put the installed package in the place of the sources beside the tests, in a checkout that is thrown away afterwards:
tests then read and import what pip has installed.
"""

import shutil
import sys
import sysconfig
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    installed = Path(sysconfig.get_path("purelib")) / "fprf"
    if not (installed / "__init__.py").is_file():
        print(f"{installed}: is not there; install the wheel, not an editable checkout", file=sys.stderr)
        return 2
    shutil.rmtree(ROOT / "fprf")
    shutil.copytree(installed, ROOT / "fprf", ignore=shutil.ignore_patterns("__pycache__"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
