"""Necks: how deep flat pads hold a neck from its end, and how far they are opened for it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tdf_jax.sim.pads import TIPS

CLEARANCE, LEAST_CLEARANCE = 0.010, 0.005  # metres between each finger and a neck, whose middle the cloud shows well
DEPTHS = (0.012, 0.052)  # metres from the end of the neck to the tips; the palm is 0.055 m behind them
LEVEL_STEP = 0.001  # metres between levels at which a neck is measured
TOUCHED = 0.0003  # metres: pads touch where the width is the largest between them, up to this
# Metres from the tips within which pads slide off a slope, and beyond which the fingers of the 2F-85, which adapt to
# what they enclose, give way; and the share that a grasp is worth there.
EDGE, UNSTEADY, AT_EDGE = 0.005, 0.009, 0.3
STEEP = 0.4  # radius over length of a slope on which the tips do not hold at all
NEAR = 0.020  # metres between pads and centre of mass, below which nearer is no better
RECESS = 0.003  # metres by which the fingers are further apart behind the pads


class Hold(NamedTuple):
    """How pads hold a neck.

    Attributes:
        depth: distance from the end of the neck to the tips, metres.
        width: width of what the pads touch, metres.
        opening: opening of the fingers before they close, metres.
        score: how well they hold it; only the order means something.
    """

    depth: float
    width: float
    opening: float
    score: float


def neck_holds(
    levels: Float[np.ndarray, " levels"],
    widths: Float[np.ndarray, " levels"],
    centre: float,
    widest: float,
    touched: float = TOUCHED,
) -> list[Hold]:
    """The depths at which pads can hold a neck.

    Pads are flat, and touch a cone at its widest ring only. A depth is better where what they touch is long, wide and
    near the centre of mass, and lies within the pads: their tips would slide off a slope.

    Args:
        levels: distances from the end of the neck, (levels,), metres, `LEVEL_STEP` apart.
        widths: widths of the object there, (levels,), metres.
        centre: distance of its centre of mass from the end of the neck, metres.
        widest: the widest opening of the gripper, metres.
        touched: pads touch where the width is the largest between them, up to this, metres.
    """
    holds = []
    for tips in np.flatnonzero(levels >= DEPTHS[0]):
        depth, inserted = levels[tips], widths[: tips + 1]
        pads = levels[: tips + 1] > depth - 2 * TIPS
        width = float(inserted[pads].max())
        clearance = min(CLEARANCE, (widest - float(inserted.max())) / 2)
        if clearance < LEAST_CLEARANCE or inserted.max() > width + RECESS:
            continue
        at = levels[: tips + 1][pads & (inserted > width - touched)]
        length, lever = float(np.ptp(at)), abs(float(at.mean()) - centre)
        score = (width + 2 * length) / max(lever, NEAR)
        if depth - at.mean() < EDGE:
            slope = float(inserted[-1] - inserted[max(0, tips - 3)]) / (6 * LEVEL_STEP)
            score *= AT_EDGE * min(max(1 - slope / STEEP, 0.01), 1)
        elif depth - at.max() > UNSTEADY:
            score *= AT_EDGE
        holds.append(Hold(float(depth), width, float(inserted.max()) + 2 * clearance, score))
    return holds
