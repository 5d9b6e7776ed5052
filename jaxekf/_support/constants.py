"""Physical constants in SI units, for every room."""

STANDARD_GRAVITY = 9.80665
"""Standard acceleration of gravity, m/s^2 (ISO 80000-3)."""
GRAVITY_REF = (0.0, 0.0, -STANDARD_GRAVITY)
"""Gravity vector (3,), m/s^2, in a reference frame whose z axis points up: the free-fall acceleration."""
