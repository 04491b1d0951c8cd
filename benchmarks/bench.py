"""Times against the peers, all in one run: prints one JSON object a line.

    python benchmarks/bench.py [--quick]

Rectifying one photo (`rectify.py`), a batch (`batch.py`), an iteration of the bundle adjustment (`bundle.py`) and the
whole run (`speed.py`, with the folder of test photos beside the project). Each line holds name, ours_s, peer_s, ratio,
floor_s, target and ok; null where there is none. Exits 1 if one is missing or crashed, never because a noisy figure
missed its target. About half an hour on two cores; with --quick a few minutes, of fewer photos, rotations and
measurements.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

KEYS = ("name", "ours_s", "peer_s", "ratio", "floor_s", "target", "ok")
MODELS = ["--models", "rotation", "constant-motion"]
# arguments, those of --quick, and how many ratios it prints at least
PARTS: dict[str, tuple[list[str], list[str], int]] = {
    "rectify.py": ([], ["--repeat", "7"], 4),
    "batch.py": ([], ["--count", "8", "--repeat", "1"], 3),
    "bundle.py": (["--sizes", "1000000", *MODELS], ["--sizes", "40000", "--repeat", "1", *MODELS], 4),
    "speed.py": ([], ["--repeat", "1"], 1),
}


def main() -> int:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    quick = parser.parse_args().quick
    missing = []
    for part, (arguments, few, least) in PARTS.items():
        command = [sys.executable, str(Path(__file__).with_name(part)), *(few if quick else arguments)]
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
