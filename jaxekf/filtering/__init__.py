"""The estimator: models, steps, the extended Kalman filter, the smoothers and their derivatives.

Modules without a leading underscore (`model`, `steps`, `interpolation`, `ekf`, `smoother`,
`iterated_smoother`) may be imported from other rooms; `lowering` and the others are of this room alone.
A run of the filter goes through them in this order: `ekf` prepares a model (`_lowered_model`,
`_linearisation`) and its inputs, `_recursion` scans them over time (`_epoch`, `_step`), and a step predicts
(`_covariance_prediction`), gates (`_gating`), resets (`_belief_reset`) and updates (`_covariance_update`,
`_iterated_update`). The smoothers go backward over the result (`_smoother_pass`). A new gate or weight goes
into `_gating`, a new form of the covariance update into `_covariance_update`.
"""
