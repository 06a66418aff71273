"""Published success rates of other systems, and which rows of a simulation stand beside them.

The protocols are those of `tdf_jax.sim.episode.teleport`; the objects are others, ShapeNet's.
"""

from typing import NamedTuple

from tdf_jax.evaluation.relation_report import PUBLISHED as R_NDF, PUBLISHED_ONE as R_NDF_ONE
from tdf_jax.sim.condition import Condition

PAPERS = {
    "NDF": "[NDF](https://arxiv.org/abs/2112.05124) (Simeonov et al., ICRA 2022)",
    "L-NDF": "[L-NDF](https://arxiv.org/abs/2302.03573) (Chun et al., ICRA 2023)",
    "R-NDF": "[R-NDF](https://arxiv.org/abs/2211.09786) (Simeonov et al., CoRL 2022)",
}
# Grasp, place and overall with ten demonstrations, upright and arbitrary poses (roll and pitch within 60 degrees).
NDF = {
    "mug_on_rack": {"upright": (0.96, 0.92, 0.88), "tilt60": (0.78, 0.75, 0.58)},
    "bowl_on_shelf": {"upright": (0.91, 1.00, 0.91), "tilt60": (0.79, 0.97, 0.78)},
    "bottle_on_shelf": {"upright": (0.87, 1.00, 0.87), "tilt60": (0.78, 0.99, 0.77)},
}
NDF_ONE = {"mug_on_rack": {"upright": 0.46}}  # overall with one demonstration
L_NDF = {  # overall with ten demonstrations
    "mug_on_rack": {"upright": 0.995, "tilt60": 0.735},
    "bowl_on_shelf": {"upright": 0.985, "tilt60": 0.905},
    "bottle_on_shelf": {"upright": 0.85, "tilt60": 0.78},
}


class Published(NamedTuple):
    """A published row.

    Attributes:
        system: key of `PAPERS`.
        demonstrations: number of demonstrations.
        grasp, place, overall: success rates; None where none is published.
    """

    system: str
    demonstrations: int
    grasp: float | None
    place: float | None
    overall: float | None


def peers_of(condition: Condition) -> list[Published]:
    """The published rows of the same protocol.

    NDF and L-NDF place on a target that stays where it was demonstrated, R-NDF finds another one and has no grasp.
    None of them executes a trajectory by friction alone, so nothing stands beside executed episodes.

    Args:
        condition: what our row is measured under.
    """
    task, poses = condition.task, condition.poses
    if condition.mode != "teleport":
        return []
    found = []
    if condition.target == "known":
        if rates := NDF.get(task, {}).get(poses):
            found.append(Published("NDF", 10, *rates))
        if one := NDF_ONE.get(task, {}).get(poses):
            found.append(Published("NDF", 1, None, None, one))
        if overall := L_NDF.get(task, {}).get(poses):
            found.append(Published("L-NDF", 10, None, None, overall))
    else:
        for demonstrations, table in ((10, R_NDF), (1, R_NDF_ONE)):
            if place := table.get(task, {}).get(poses):
                found.append(Published("R-NDF", demonstrations, None, place, None))
    return found
