import subprocess
import sys
from importlib.metadata import entry_points

import pytest

from fprf.errors import ConfigError
from fprf.plugins.stylizers.config import LocalAdainConfig, RegionAdainConfig, RegionOtConfig, RegionToneConfig, StylizerConfig


def test_every_entry_point_is_a_stylizer_config_with_defaults() -> None:
    found = {e.name: e.load() for e in entry_points(group="fprf.stylizers") if e.value.startswith("fprf.")}
    assert set(found) == {"identity", "adain", "local-adain", "region-adain", "region-ot", "region-tone"}
    assert all(isinstance(config(), StylizerConfig) for config in found.values())


@pytest.mark.parametrize("config", [LocalAdainConfig, RegionAdainConfig, RegionOtConfig, RegionToneConfig])
@pytest.mark.parametrize("temperature", [0.0, -1.0, float("nan"), float("inf")])
def test_temperatures_are_above_zero(config: type[LocalAdainConfig], temperature: float) -> None:
    with pytest.raises(ConfigError, match=r"stylizer\.temperature"):
        config(temperature=temperature)


@pytest.mark.parametrize("config", [RegionAdainConfig, RegionOtConfig, RegionToneConfig])
def test_gain_has_a_range(config: type[RegionOtConfig]) -> None:
    with pytest.raises(ConfigError, match=r"stylizer\.gain"):
        config(gain=0.99)


def test_configs_import_no_torch() -> None:
    code = "import sys, fprf.plugins.stylizers.config; sys.exit(any(m in sys.modules for m in ('torch', 'numpy', 'cv2')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
