#!/usr/bin/env bash
# scikit-learn's MLPRegressor(warm_start=True) is the documented way to go on training, say with a smaller learning
# rate. The count of passes without improvement is not begun anew with the next fit: what the first fit left in it
# counts against the second one's patience (n_iter_no_change), which then ends after a single pass of the three asked
# for, and calls that convergence. (Met where networks are trained in phases of falling rate: tol=0 with a patience
# longer than all phases together avoids it.)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet scikit-learn==1.9.1 numpy==2.4.6 scipy==1.17.1
cat > "$folder/see.py" <<'PY'
import warnings

import numpy as np
import sklearn
from sklearn.neural_network import MLPRegressor

warnings.simplefilter("ignore")
rng = np.random.default_rng(0)
rows = rng.standard_normal((500, 3))
target = rows[:, 0] * rows[:, 1]


def passes(first, second, **options):
    """Passes that two fits in a row really made; a tol above any loss makes every pass count as no improvement."""
    model = MLPRegressor(hidden_layer_sizes=(8,), random_state=0, warm_start=True, **options)
    model.set_params(max_iter=first, n_iter_no_change=first + 2).fit(rows, target)
    made = model.n_iter_
    model.set_params(max_iter=second, n_iter_no_change=second + 2, learning_rate_init=1e-4).fit(rows, target)
    return made, len(model.loss_curve_) - made


print("scikit-learn", sklearn.__version__)
seen, alone = passes(8, 3, tol=1e9), passes(1, 3, tol=1e9)
print("asked for 8 passes, then 3 with a patience of 5: made", seen)
print("asked for 1 pass, then 3 with a patience of 5:   made", alone)
assert seen == (8, 1) and alone == (1, 3), "scikit-learn changed: look again"
print("seen: the second fit inherits the first one's count and stops after one pass")
PY
"$folder/venv/bin/python" "$folder/see.py"
