"""The chi-square distribution, with the same results as `scipy.stats.chi2`.

The import of `scipy.stats` takes most of a second, that of `scipy.special` almost none. Degrees of freedom
that are not positive give NaN, as in SciPy.
"""

from typing import Any

import numpy as np
from scipy.special import chdtr, chdtrc, gammaincinv


def ppf(probability: Any, degrees: Any) -> Any:
    """The quantile: the value that is exceeded with one minus this probability."""
    return 2.0 * gammaincinv(_positive(degrees) / 2.0, probability)


def cdf(value: Any, degrees: Any) -> Any:
    """The probability of a smaller value."""
    return chdtr(_positive(degrees), np.maximum(value, 0.0))


def sf(value: Any, degrees: Any) -> Any:
    """The probability of a larger value."""
    return chdtrc(_positive(degrees), np.maximum(value, 0.0))


def deviation_interval(deviation: Any, degrees: Any) -> tuple[Any, Any]:
    """The 95 % confidence interval of a standard deviation estimated with these degrees of freedom."""
    low, high = (deviation * np.sqrt(degrees / ppf(share, degrees)) for share in (0.975, 0.025))
    return low, high


def _positive(degrees: Any) -> Any:
    return np.where(np.greater(degrees, 0), degrees, np.nan)
