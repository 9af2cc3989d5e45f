"""From signals to estimates, sample by sample, in batch and live."""
