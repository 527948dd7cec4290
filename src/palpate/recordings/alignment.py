"""Stamped values on a uniform grid: in order, interpolated, or averaged over a period.

Values are (stamps, *shape), times (stamps,) in s and ascending but for `in_order`.
"""

import numpy as np


def in_order(
    time: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Rows sorted by stamp, the last of equal stamps kept, and what was done to get there."""
    notes = []
    behind = np.maximum.accumulate(time) - time
    if late := int((behind > 0).sum()):
        notes.append(
            f"{late} of {len(time)} rows were out of order, by up to {behind.max():.4g} s, "
            "and were sorted"
        )
        order = np.argsort(time, kind="stable")
        time, values = time[order], values[order]
    last = np.append(np.diff(time) > 0, True)
    if repeated := int((~last).sum()):
        notes.append(f"{repeated} rows had the stamp of a later row and were dropped")
        time, values = time[last], values[last]
    return time, values, tuple(notes)


def interpolate(
    time: np.ndarray, values: np.ndarray, grid: np.ndarray, gap: float, slack: float
) -> np.ndarray:
    """Values (len(grid), *shape) at `grid`, NaN where a neighbour is unseen or over `gap` s away.

    A frame within `slack` seconds of a stamp stands on it and needs no other neighbour.
    """
    right = np.clip(np.searchsorted(time, grid), 1, len(time) - 1)
    left = right - 1
    span = time[right] - time[left]
    weight = np.clip((grid - time[left]) / span, 0.0, 1.0)
    on_stamp = np.minimum(weight, 1 - weight) * span <= slack
    nearest = values[np.where(weight < 0.5, left, right)]

    def per_row(row: np.ndarray) -> np.ndarray:
        return row.reshape(-1, *(1,) * (values.ndim - 1))

    between = (1 - per_row(weight)) * values[left] + per_row(weight) * values[right]
    too_wide = span > gap
    between[too_wide & ~on_stamp] = np.nan
    return np.where(per_row(on_stamp) & np.isnan(between), nearest, between)


def mean_in_force(
    time: np.ndarray, values: np.ndarray, grid: np.ndarray, slack: float
) -> np.ndarray:
    """The mean of orders from each frame of `grid` to the next, (len(grid) - 1, *shape).

    Each is in force until the next; a stamp within `slack` seconds of a frame is on it.
    """
    first = np.searchsorted(time, grid[:-1] + slack, side="right") - 1
    last = np.searchsorted(time, grid[1:] - slack, side="right") - 1
    held = values[first]
    several = last > first
    if not several.any():
        return held
    # the integral is linear between the stamps, and beyond the last
    stamps = np.append(time, max(grid[-1], time[-1]))
    lasting = np.diff(stamps).reshape(-1, *(1,) * (values.ndim - 1))
    flat = (values * lasting).reshape(len(values), -1)
    integral = np.concatenate([np.zeros((1, flat.shape[1])), np.cumsum(flat, axis=0)])
    at = np.stack([np.interp(grid, stamps, column) for column in integral.T], axis=1)
    mean = np.diff(at, axis=0) / np.diff(grid)[:, None]
    held[several] = mean.reshape(held.shape)[several]
    return held
