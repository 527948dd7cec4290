"""Identified values and their intervals as text, with as many figures as mean something."""

import math

import numpy as np

from palpate.report.evidence import Parameter

_FEW = 4  # elements of a parameter that are told one by one


def number(value: float) -> str:
    """To three figures, or all digits before the point: "1430", "0.0123", "2.2×10⁻⁴"."""
    if math.isnan(value):
        return "unknown"
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        digits = max(3, math.floor(math.log10(abs(value) or 1)) + 1)
        text = np.format_float_positional(value, precision=digits, fractional=False, trim="-")
    else:
        mantissa, exponent = f"{value:.2e}".split("e")
        text = f"{float(mantissa):g}×10{str(int(exponent)).translate(_RAISED)}"
    return text.replace("-", "−")


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def elements(row: Parameter) -> str:
    """Its elements without the unit: one by one, or from the least to the greatest of many."""
    values = row.value
    if 1 < values.size <= _FEW:
        return "; ".join(number(float(value)) for value in values.ravel())
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (math.nan, math.nan)
    if not known.size or math.isclose(low, high, rel_tol=5e-4):
        return number(low)
    return f"{number(low)} to {number(high)}"


def interval(row: Parameter) -> str:
    """The interval, or what is typical of the elements' intervals relative to their values."""
    known = np.isfinite(row.lower) & np.isfinite(row.upper) & (row.value != 0)
    if not known.any():
        return "–"
    if row.value.size <= _FEW:
        edges = zip(row.lower.ravel(), row.upper.ravel(), strict=True)
        return "; ".join(f"{number(low)} to {number(high)}" for low, high in edges)
    value = row.value[known]
    sides = (np.median((edge[known] - value) / np.abs(value)) for edge in (row.lower, row.upper))
    return "typically " + " to ".join(f"{side:+.0%}" for side in sides).replace("-", "−")
