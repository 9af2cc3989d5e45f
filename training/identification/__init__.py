"""A car's parameters and its sensors' errors, found in logs."""
