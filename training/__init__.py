"""Everything that needs ground truth: simulated data sets, labels, folds, fitting and metrics."""
