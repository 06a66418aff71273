"""The target of a demonstration: the second object, on which or in which the first one is placed."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3

IDENTITY = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
# Largest distance of the contact points from the cloud, its diagonals. Descriptors fade with the distance.
FARTHEST_CONTACT = 0.2


@dataclasses.dataclass(frozen=True)
class Target:
    """The object that a demonstrated object is placed on or in, such as a rack, with the region where the two meet.

    Attributes:
        points: point cloud of the target as it stands at the release, (points, 3), metres, world frame.
        query: contact points: query points of the region where object and target meet, (queries, 3), metres, contact
            frame.
        T_world_contact: pose of the contact frame at the release, `wxyz_xyz`, (7,), metres; by default the identity,
            with contact points given in the world.

    Raises:
        InputError: the points are not a point cloud, the contact points are not (queries, 3) and finite or are not at
            the target, or the pose is not one finite pose.
    """

    points: Float[Array | np.ndarray, "points 3"]
    query: Float[Array | np.ndarray, "queries 3"]
    T_world_contact: Float[Array | np.ndarray, "7"] = dataclasses.field(default_factory=lambda: np.array(IDENTITY))

    @public
    def __post_init__(self):
        # Stored as the checks return them, so that lists and arrays of other libraries are converted once.
        object.__setattr__(self, "points", checks.points("Target()", self.points))
        object.__setattr__(self, "query", checks.query("Target()", self.query))
        object.__setattr__(self, "T_world_contact", checks.pose("Target()", "T_world_contact", self.T_world_contact))
        if checks.traced(self.points, self.query, self.T_world_contact):
            return
        cloud = np.asarray(self.points, np.float64)
        checks.near("Target()", "points", cloud, self.points)
        check_contact("Target()", "target", cloud, np.asarray(self.query), np.asarray(self.T_world_contact))


def check_contact(function: str, what: str, cloud: np.ndarray, query: np.ndarray, T_world_contact: np.ndarray) -> None:
    """Check that contact points lie at a cloud.

    Args:
        function: name that the message begins with.
        what: what the message calls the object of the cloud.
        cloud: point cloud, (points, 3), metres.
        query: contact points, (queries, 3), metres, contact frame.
        T_world_contact: pose of the contact frame, `wxyz_xyz`, (7,), in the frame of the cloud.

    Raises:
        InputError: the nearest contact point is farther from the nearest point than a fifth of the cloud's diagonal.
    """
    from scipy.spatial import KDTree

    contact = np.asarray(se3.transform(jnp.asarray(T_world_contact), jnp.asarray(query)))
    nearest = KDTree(np.asarray(cloud, float)).query(np.asarray(contact, float))[0].min()
    diagonal = np.linalg.norm(np.ptp(cloud, axis=0))
    if nearest > FARTHEST_CONTACT * diagonal:
        raise InputError(
            f"{function}: the contact points are {nearest:.3g} m from the {what}, whose diagonal is "
            f"{diagonal:.3g} m; expected them where object and target meet at the release. Check their frame and unit, "
            "or take tdf.contact_query"
        )
