"""Simulated runs with ground truth, and the demo runs that come with the package.

`attitude_runs` simulates a tracked attitude with an IMU, `marker_runs` a tool with single markers,
`camera_runs` landmarks in images, `gyro_free_runs` an accelerometer array. All modules are public. A new
rig is a file here that returns a `Recording` with its ground truth.
"""

from jaxekf._support.lazy import attributes

# Modules are imported when they are first used.
__getattr__, __dir__ = attributes(__name__, {})
