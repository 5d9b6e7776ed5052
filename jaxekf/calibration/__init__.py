"""Clock offsets, extrinsic rotations and sensor noise from data, before any filter runs.

`alignment` finds clock and tracker-to-IMU rotation of whole runs (`time_offset` first, then
`attitude_alignment`); `static_noise` finds noise densities of a static recording (`allan`,
`noise_densities`, `static_interval`). All modules are public. A new calibration is a file here and, where
it has a command, one in `jaxekf.cli`.
"""

from jaxekf._support.lazy import attributes

# Modules are imported when they are first used.
__getattr__, __dir__ = attributes(__name__, {})
