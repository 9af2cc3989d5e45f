"""Columns of a sample and of an estimate, by name; kernels write ``sample[at.VX]`` and ``out[at.BETA]``.

Taken as ``from crosscomb.filters import columns as at``: to the compiler each is a constant.
"""

VX, AX, AY, YAW_RATE, STEER, STEER_REAR, FXF, FXR, VX_HELD, STEER_HELD = range(10)
VFL, VFR, VRL, VRR, GNSS_SPEED, GNSS_COURSE, HEADING = range(10, 17)
"""Columns of a sample: what kernels read, see `crosscomb.filters.base.Inputs`."""

SAMPLE_WIDTH = 17

BETA, BETA_STD, NIS = range(3)
"""Columns of an estimate: what kernels write; an estimator's extras follow."""
