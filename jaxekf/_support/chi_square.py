"""The chi-square distribution, with the numbers of `scipy.stats`.

`scipy.stats` takes most of a second to import, half of what this whole package does; the special
functions behind it take none. Degrees of freedom that are not positive give NaN, as there.
"""

from typing import Any

import numpy as np
from scipy.special import chdtr, chdtrc, gammaincinv


def ppf(share: Any, degrees: Any) -> Any:
    """The bound that a share of values stays below."""
    return 2.0 * gammaincinv(_positive(degrees) / 2.0, share)


def cdf(value: Any, degrees: Any) -> Any:
    """The probability of less than `value`."""
    return chdtr(_positive(degrees), np.maximum(value, 0.0))


def sf(value: Any, degrees: Any) -> Any:
    """The probability of more than `value`."""
    return chdtrc(_positive(degrees), np.maximum(value, 0.0))


def deviation_interval(deviation: Any, degrees: Any) -> tuple[Any, Any]:
    """The 95 % confidence interval of a standard deviation estimated with these degrees of freedom."""
    low, high = (deviation * np.sqrt(degrees / ppf(share, degrees)) for share in (0.975, 0.025))
    return low, high


def _positive(degrees: Any) -> Any:
    return np.where(np.greater(degrees, 0), degrees, np.nan)
