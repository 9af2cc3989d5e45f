"""From recordings to a trained selector, and how good it is on what it has not seen."""
