"""The estimator: models, steps, the extended Kalman filter, the smoothers and their derivatives.

Modules without a leading underscore (`model`, `steps`, `interpolation`, `ekf`, `smoother`,
`iterated_smoother`) may be imported from other rooms; `lowering` and the others are of this room alone.
A gate or a weight goes into `_gating`, a covariance update into `_covariance_algebra`.
"""
