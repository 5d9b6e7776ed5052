"""From a recording to an estimate: timeline, padding, batches of runs, causal and live estimates, results.

`batch` estimates whole runs, `causal` estimates with measurements that arrive late, `live` takes samples
as they arrive. `result` holds the estimate and writes the result folder.
"""

from jaxekf._support.lazy import attributes, names_of

# Functions that were here while this room was one module.
_BATCH = ("estimate", "estimate_many", "read", "require_float64", "sharing_devices")
__getattr__, __dir__ = attributes(
    __name__,
    names_of("jaxekf.estimation.batch", *_BATCH)
    | names_of("jaxekf.estimation.versions", "provenance"),
)
