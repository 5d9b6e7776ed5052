"""Accuracy and consistency of an estimate: scores, NEES, NIS, whiteness, diagnosis.

`metrics` compares with ground truth, `consistency` computes the statistics of innovations and errors,
`diagnosis` combines them into the sentences of `verdicts`; `spread` has statistics over runs. All modules
without a leading underscore are public. A new score goes into `metrics`; a new fault that `diagnose` names
gets its signature in `_fault_signatures`.
"""

from jaxekf._support.lazy import attributes

# Modules are imported when they are first used.
__getattr__, __dir__ = attributes(__name__, {})
