"""Does a recording agree with its description: units, quaternion order, frames, clocks, camera.

`plausibility` runs whenever a run is read and refuses a contradiction; `inspection` gathers all findings
for `jaxekf check`. A new check measures in `sensor_agreement` or `_camera_agreement` and judges in
`plausibility`.
"""
