import sys

import pytest
from fake_packages import ENCODER, Packages
from hypothesis import given
from hypothesis import strategies as st

from fprf.errors import PluginError
from fprf.plugins import registry
from fprf.plugins.encoders.config import EncoderConfig, RandomConfig, Vgg19Config

GROUP = "fprf.encoders"


def test_built_ins_are_listed_by_name_and_found_by_class() -> None:
    assert list(registry.installed(GROUP)) == sorted(registry.installed(GROUP))
    assert registry.load(GROUP, "vgg19", EncoderConfig) is Vgg19Config
    assert registry.name_of(GROUP, RandomConfig) == "random"
    assert registry.entry(GROUP, "vgg19").package.startswith("fprf ")
    assert GROUP in registry.groups() and all(group.startswith("fprf.") for group in registry.groups())
    assert not registry.installed("fprf.no-such-group")


def test_a_strangers_plugin_is_listed_without_being_imported(packages: Packages) -> None:
    packages.install("acme-clip", {GROUP: {"acme": "acme_a:ClipConfig"}}, code={"acme_a": ENCODER.format(name="Clip")})
    assert "acme" in registry.installed(GROUP)
    assert "acme_a" not in sys.modules
    found = registry.load(GROUP, "acme", EncoderConfig)
    assert found.__name__ == "ClipConfig"
    assert registry.entry(GROUP, "acme").origin == "acme_a:ClipConfig from acme-clip 1"


@pytest.mark.parametrize(
    ("source", "shown"),
    [
        ("import not_there_at_all", "ModuleNotFoundError: No module named 'not_there_at_all'"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("class Odd(BaseException): ...\nraise Odd('odd')", "Odd: odd"),
        ("def f(:", "SyntaxError"),
        ("def f(): f()\nf()", "RecursionError"),
        ("raise Warning('as an error')", "Warning: as an error"),
        ("x = 1", "AttributeError"),
    ],
)
def test_a_broken_import_names_the_package_and_the_cause(packages: Packages, source: str, shown: str) -> None:
    packages.install("acme-bad", {GROUP: {"bad": "acme_bad:BadConfig"}}, code={"acme_bad": source})
    assert "bad" in registry.installed(GROUP)
    with pytest.raises(PluginError, match=r"'bad' \(acme_bad:BadConfig from acme-bad 1\) failed to import") as caught:
        registry.load(GROUP, "bad", EncoderConfig)
    assert shown in str(caught.value)


def test_damaged_metadata_hurts_nobody_else(packages: Packages) -> None:
    packages.raw("acme-damaged", "[fprf.encoders]\nno equals sign here\n")
    packages.raw("acme-foreign", "[console_scripts]\nno equals sign here\n")
    assert "vgg19" in registry.installed(GROUP)
    complaints = registry.unreadable()
    assert len(complaints) == 1 and str(packages.root) in complaints[0]


@given(st.text(max_size=20).filter(lambda name: name not in registry.installed(GROUP)))
def test_any_unknown_name_is_one_plugin_error(name: str) -> None:
    with pytest.raises(PluginError):
        registry.load(GROUP, name, EncoderConfig)


def test_an_interrupt_while_importing_is_an_interrupt(packages: Packages) -> None:
    packages.install("acme-slow", {GROUP: {"slow": "acme_slow:S"}}, code={"acme_slow": "raise KeyboardInterrupt"})
    with pytest.raises(KeyboardInterrupt):
        registry.load(GROUP, "slow", EncoderConfig)
