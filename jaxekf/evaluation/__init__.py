"""Is an estimate right, and does its covariance match its errors: scores, NEES, NIS, whiteness, diagnosis.

All modules without a leading underscore are public. A new score goes into `metrics`; a new fault that
`diagnose` names gets its signature in `_fault_signatures`.
"""

from jaxekf._support.lazy import attributes

# Modules are imported when they are first used.
__getattr__, __dir__ = attributes(__name__, {})
