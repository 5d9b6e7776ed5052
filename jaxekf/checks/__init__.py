"""Does a recording agree with its description: units, quaternion order, frames, clocks, camera.

`plausibility` runs whenever a run is read and refuses a contradiction; `inspection` gathers all findings
for `jaxekf check`. `sensor_agreement` and `_camera_agreement` measure and do not judge. A new
check measures in one of these two; it warns in `inspection`, or, if the run must be refused, raises in
`plausibility`. Faults of one sensor, such as a clipped gyroscope, have a module each, whose function
`inspection` lists in `SENSOR_CHECKS`.
"""
