"""Hashes of all that `estimate` writes for some logs: equal before and after a change that must not alter a bit.

    python benchmarks/output_hashes.py DATA --write before.json      # with the old commit installed
    python benchmarks/output_hashes.py DATA --against before.json    # with the new one

All estimators of the catalogue run on six real logs, beside the shipped tree and beside the shipped hybrid, with
extras, a point and handling. Only the command line is used, so that any two commits can be compared; hashes of two
machines need not agree.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

LOGS = (
    "kth_volvo_s90/stepsteer_left_100kph.csv",
    "kth_volvo_v40/sine_with_dwell_80kph.csv",
    "liu_course/double_lane_change_49kph.csv",
    "stanford_gti_2018/oval_aa.csv",
    "stanford_gti_2019/double_lane_change_1.csv",
    "stanford_gti_limits/wet_1.csv",
)
ARTEFACTS: dict[str, list[str]] = {"tree": [], "hybrid": ["--selector-file", "hybrid"]}
OPTIONS = ["--filters", "all", "--extras", "--handling", "--point", "-1.4,0.2"]


def hashes(command: str, data: Path) -> dict[str, str]:
    """SHA-256 of each table, by artefact and name."""
    found = {}
    for artefact, chosen in ARTEFACTS.items():
        for log in LOGS:
            with tempfile.TemporaryDirectory() as folder:
                call = [command, "estimate", str(data / log), *chosen, *OPTIONS, "-o", folder]
                subprocess.run(call, check=True, stdout=subprocess.DEVNULL)
                for table in sorted(Path(folder).glob("*.csv")):
                    found[f"{artefact}/{table.name}"] = hashlib.sha256(table.read_bytes()).hexdigest()
    return found


def main() -> None:
    """Print the hashes, keep them, or hold them against kept ones."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, help="folder of the real logs")
    parser.add_argument("--command", default="crosscomb", help="command of the commit to hash")
    parser.add_argument("--write", type=Path)
    parser.add_argument("--against", type=Path)
    asked = parser.parse_args()
    found = hashes(asked.command, asked.data)
    if asked.write:
        asked.write.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if not asked.against:
        print("\n".join(f"{value}  {name}" for name, value in found.items()))
        return
    kept = json.loads(asked.against.read_text(encoding="utf-8"))
    different = sorted(name for name in kept | found if kept.get(name) != found.get(name))
    print(
        "\n".join(
            [*(f"differs: {name}" for name in different), f"{len(found)} tables, {len(different)} differ"]
        )
    )
    sys.exit(1 if different else 0)


if __name__ == "__main__":
    main()
