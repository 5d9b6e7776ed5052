"""Is a recording what its description says: units, quaternion order, frames, clocks, camera.

`plausibility` is asked whenever a run is read and refuses what cannot be; `inspection` gathers all
findings for `jaxekf check`. A new check measures in `sensor_agreement` or `_camera_agreement` and
judges in `plausibility`.
"""
