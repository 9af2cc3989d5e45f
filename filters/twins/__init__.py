"""The kernels' twins, slow and plain, on filterpy's classes or in numpy: what kernels are tested and timed against.

Only tests and `crosscomb benchmark speed` use them, and nothing else in the package imports filterpy. They call the
same model functions as the kernels, so no formula stands twice.
"""
