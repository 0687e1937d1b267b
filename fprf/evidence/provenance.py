"""Where figures come from: commit, machine, versions."""

import os
import platform
import subprocess
from pathlib import Path

import torch

from .. import __version__
from ..training.prepare import device_of

__all__ = ["commit", "provenance", "words"]


def provenance(device: str) -> dict[str, object]:
    """What a report carries besides its settings; nothing in it depends on the time. `device` as configs name it."""
    return {
        "commit": commit(Path(__file__).parent),
        "fprf": __version__,
        "torch": torch.__version__,
        "machine": _machine(device_of(device)),
    }


def commit(folder: Path) -> str | None:
    """Short hash of the checkout that a folder lies in, with `+` where known files were changed; None outside of one."""
    try:
        found = subprocess.run(  # nosec B607  # git as the user has it; fixed words
            ["git", "-C", str(folder), "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"],
            capture_output=True,
            text=True,
            timeout=30,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.strip() or None


def words(found: dict[str, object]) -> str:
    """A line for a page."""
    where = f"commit {found['commit']}, " if found["commit"] else ""
    return f"{where}fprf {found['fprf']}, torch {found['torch']}, {found['machine']}"


def _machine(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{os.cpu_count()} {platform.machine().replace('_', '-')} cores"
