"""Poses, tilt and angular rate of single instants, without a filter.

`marker_pose` solves poses from markers, `pnp` from image points, `tilt` the vertical from an IMU, and
`gyro_free_rate` the rate from an `accelerometer_array`. All modules are public. A new solver is a file
here; a model uses it in its `find_start` or as a pseudo-measurement.
"""

from jaxekf._support.lazy import attributes

# Modules are imported when they are first used.
__getattr__, __dir__ = attributes(__name__, {})
