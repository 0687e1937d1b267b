import subprocess
import sys
from importlib.metadata import entry_points

from fprf.plugins.stylizers.config import StylizerConfig


def test_every_entry_point_is_a_stylizer_config_with_defaults() -> None:
    found = {e.name: e.load() for e in entry_points(group="fprf.stylizers") if e.value.startswith("fprf.")}
    assert set(found) == {"identity", "adain", "local-adain", "region-adain", "region-ot", "region-tone"}
    assert all(isinstance(config(), StylizerConfig) for config in found.values())


def test_configs_import_no_torch() -> None:
    code = "import sys, fprf.plugins.stylizers.config; sys.exit(any(m in sys.modules for m in ('torch', 'numpy', 'cv2')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
