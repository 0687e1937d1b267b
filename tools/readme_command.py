"""Print one of the README's commands under "Two commands", 1 or 2, as it stands there: `python -m tools.readme_command 1`."""

import re
import sys
from pathlib import Path

README = Path(__file__).resolve().parents[1] / "README.md"


def commands() -> list[str]:
    section = README.read_text("utf-8").partition("## Two commands")[2].partition("\n## ")[0]
    return [block.strip() for block in re.findall(r"^```sh\n(.*?)^```", section, re.DOTALL | re.MULTILINE)][
        :2
    ]


if __name__ == "__main__":
    print(commands()[int(sys.argv[1]) - 1])
