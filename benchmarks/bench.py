"""Times against the peers, all in one run: prints one JSON object a line.

    python benchmarks/bench.py

Rectifying one photo (`rectify.py`), a batch (`batch.py`), an iteration of the bundle adjustment (`bundle.py`) and the
whole run (`speed.py`, with the folder of test photos beside the project). Each line holds name, ours_s, peer_s, ratio,
floor_s, target and ok; null where there is none. Exits 1 if one is missing or crashed, never because a noisy figure
missed its target.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

KEYS = ("name", "ours_s", "peer_s", "ratio", "floor_s", "target", "ok")
# how many ratios each prints at least
PARTS = {
    "rectify.py": ([], 4),
    "batch.py": ([], 3),
    "bundle.py": (["--sizes", "1000000", "--models", "rotation", "constant-motion"], 4),
    "speed.py": ([], 1),
}


def main() -> int:
    """Measure."""
    missing = []
    for part, (arguments, least) in PARTS.items():
        command = [sys.executable, str(Path(__file__).with_name(part)), *arguments]
        found = 0
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            for line in process.stdout or ():
                value = json.loads(line)
                if "skipped" in value:
                    print(line, end="", flush=True)
                    found = least
                elif value.get("ratio") is not None:
                    print(json.dumps({**dict.fromkeys(KEYS), **value}), flush=True)
                    found += 1
        if process.returncode or found < least:
            missing.append(f"{part} ended with {process.returncode} after {found} of {least} figures")
    print("\n".join(missing), file=sys.stderr)
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
