#!/usr/bin/env bash
# joblib.Parallel documents mmap_mode=None as "no memory mapping of large arrays". With it a large array cannot be
# sent at all: each task fails while it is unpacked, and the error blames arguments that cannot be pickled. What does
# switch mapping off is max_nbytes=None. (Met while processes were to share the arrays of a training.)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet joblib==1.6.0 numpy==2.4.6
cat > "$folder/see.py" <<'PY'
import joblib
import numpy as np
from joblib import Parallel, delayed

large = np.ones(500_000)  # 4 MB, above the default max_nbytes of 1 MB


def outcome(**options):
    try:
        return f"sums {Parallel(n_jobs=2, **options)(delayed(np.sum)(large) for _ in range(2))}"
    except Exception as error:
        return f"{type(error).__name__}: {str(error).splitlines()[-1]}; from: {str(error.__cause__).strip().splitlines()[-2:]}"


if __name__ == "__main__":
    print("joblib", joblib.__version__)
    print("mmap_mode='r'    ", outcome(mmap_mode="r"))
    print("max_nbytes=None  ", outcome(max_nbytes=None))
    seen = outcome(mmap_mode=None)
    print("mmap_mode=None   ", seen)
    assert "sums" in outcome(mmap_mode="r") and "sums" in outcome(max_nbytes=None)
    assert "BrokenProcessPool" in seen and "no attribute 'filename'" in seen, "joblib changed: look again"
    print("seen: with mmap_mode=None a large array fails in the worker instead of being sent unmapped")
PY
cd "$folder" && "$folder/venv/bin/python" see.py
