"""The kernels' twins, slow and plain, on filterpy: what they are tested against."""
