"""What the page's player (`assets/player.js`) draws: chains of points as 16-bit numbers.

In base64 they take half the room of digits, and a motion of a metre keeps 0.02 mm.
"""

import base64
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from palpate.report.evidence import Motion
from palpate.report.style import FANS, STYLES

_RATE = 50.0  # pictures a second; the player interpolates between them
_MOST_FRAMES = 1000
_GAP = -32768


def scene(motions: Sequence[Motion], looks: Mapping[str, int]) -> dict[str, Any]:
    """The motions of one run, thinned to 50 frames a second and at most 1000.

    A coordinate in metres is offset + step x its 16-bit number (frames, points, 3), little-endian
    in base64; -32768 stands for a gap.
    """
    return {"groups": [_group(motion, looks) for motion in motions]}


def _group(motion: Motion, looks: Mapping[str, int]) -> dict[str, Any]:
    duration = float(motion.time[-1] - motion.time[0])
    wanted = min(len(motion.time), _MOST_FRAMES, math.ceil(duration * _RATE) + 1)
    frames = np.unique(np.linspace(0, len(motion.time) - 1, wanted).round().astype(int))
    finite = [chain[np.isfinite(chain)] for chain in motion.chains.values()]
    known = np.concatenate([*finite, [0.0] * (not any(map(np.size, finite)))])
    low, high = float(known.min()), float(known.max())
    step = max(high - low, 1e-6) / 65534
    chains, fan = [], any(label in FANS for label in motion.chains)
    for label, chain in motion.chains.items():
        scaled = np.round((chain[frames] - (low + high) / 2) / step)
        numbers = np.where(np.isfinite(scaled), scaled, _GAP).astype("<i2")
        style = STYLES[looks[label]]
        chains.append(
            {
                "label": label,
                "look": looks[label],
                "dash": style.dash,
                "width": style.width,
                "points": chain.shape[1],
                "lines": not np.isfinite(chain[:, -1]).any(),  # which a gap ends
                "faint": fan and looks[label] > 0,  # one of many lines
                "data": base64.b64encode(numbers.tobytes()).decode(),
            }
        )
    return {
        "name": motion.group,
        "time": [round(float(t), 4) for t in motion.time[frames]],
        "offset": (low + high) / 2,
        "step": step,
        "chains": chains,
    }
