"""Viewers that stand in for the real one: what a process may do beside training, good or bad."""

import sys

_HELLO = """
import json, sys
def tell(line):
    print(json.dumps(line), flush=True)
settings = json.loads(sys.stdin.readline())
tell({"address": "http://here/", "settings": settings})
"""
QUIET = _HELLO + "sys.stdin.read()"
"""Nobody looks."""
GREEDY = (
    _HELLO
    + """
tell({"looking": True, "want": True})
with open(sys.argv[1], "w") as log:
    for line in sys.stdin:
        said = json.loads(line)
        if "snapshot" in said:
            with open(said["snapshot"], "rb") as file:  # safetensors: the length of a JSON header, and that
                said["names"] = sorted(json.loads(file.read(int.from_bytes(file.read(8), "little"))))
            tell({"want": True})
        print(json.dumps(said), file=log, flush=True)
        if "done" in said:
            tell({"looking": False})
"""
)
"""Wants new parameters as soon as it has some; writes down what it hears."""
DEAF = _HELLO + 'tell({"looking": True, "want": True})\nimport time; time.sleep(600)'
"""Says that it looks, and reads nothing."""
NONSENSE = _HELLO + 'tell({"looking": True, "want": True}); print("{", flush=True); sys.stdin.read()'
DEAD = _HELLO + 'tell({"looking": True, "want": True}); raise RuntimeError("it fell over")'
REFUSED = 'import json; print(json.dumps({"error": "no such place"}), flush=True)'


def viewer(script: str, *args: str) -> tuple[str, ...]:
    return (sys.executable, "-c", script, *args)
