"""What the bodies of a cell look like: coloured surfaces of few triangles, for pictures."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from tdf_jax.sim.physics import extra
from tdf_jax.sim.robot import PREFIX

MOST_OF_GEOM, MOST_OF_BODY = 700, 10_000  # triangles of one geom of a robot, and of an object or a target
ANGULAR = 200  # triangles, of fewer a surface has flat faces, as a box has
FINEST, COARSER = 1 / 150, 1.2  # first cell of the vertices, in the diagonal of a surface, and the factor to the next


@dataclasses.dataclass(frozen=True, eq=False)
class Solid:
    """A surface of one colour that moves with a body.

    Attributes:
        body: name of the body.
        vertices: vertices, (vertices, 3), metres, body frame.
        faces: indices of the vertices of each triangle, (faces, 3).
        colour: red, green and blue from 0 to 1.
    """

    body: str
    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    colour: tuple[float, float, float]

    @property
    def angular(self) -> bool:
        """Whether the surface has flat faces, which are not shaded smoothly."""
        return len(self.faces) < ANGULAR


def simplified(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], most: int
) -> tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]:
    """A surface with fewer triangles: vertices in one cell of a grid become one, the finest grid that is enough.

    Args:
        vertices: vertices, (vertices, 3).
        faces: indices of the vertices of each triangle, (faces, 3).
        most: largest number of triangles.

    Returns:
        Vertices and faces.
    """
    vertices, faces = np.asarray(vertices, float), np.asarray(faces)
    cell = FINEST * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    fewer, kept = vertices, faces
    while len(kept) > most:
        _, cluster, counts = np.unique(
            np.round(vertices / cell).astype(int), axis=0, return_inverse=True, return_counts=True
        )
        fewer = np.stack([np.bincount(cluster, axis) for axis in vertices.T], axis=1) / counts[:, None]
        kept = cluster[faces]
        kept = kept[(kept[:, 0] != kept[:, 1]) & (kept[:, 1] != kept[:, 2]) & (kept[:, 2] != kept[:, 0])]
        _, first = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
        kept = kept[np.sort(first)]
        cell *= COARSER
    used, index = np.unique(kept, return_inverse=True)
    return fewer[used], index.reshape(-1, 3)


def robot_solids(model: Any) -> list[Solid]:
    """The surfaces of the robot in a cell: of each body those for pictures, or those for contacts if it has no others.

    Args:
        model: the `mujoco.MjModel`.
    """
    solids = []
    for body in range(1, model.nbody):
        name = model.body(body).name
        if not name.startswith(PREFIX):
            continue
        geoms = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] == body]
        pictures = [geom for geom in geoms if not model.geom_contype[geom] and not model.geom_conaffinity[geom]]
        for geom in pictures or geoms:
            surface = _surface(model, geom)
            if surface is not None:
                solids.append(Solid(name, *simplified(*surface, MOST_OF_GEOM), _colour(model, geom)))
    return solids


def _surface(model: Any, geom: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices in the body's frame, and faces; None of kinds that are not drawn, such as planes."""
    import trimesh

    kinds, size = extra("robot_solids()", "mujoco").mjtGeom, model.geom_size[geom]
    match kinds(model.geom_type[geom]):
        case kinds.mjGEOM_MESH:
            mesh = int(model.geom_dataid[geom])
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            start, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
            vertices = np.asarray(model.mesh_vert[first : first + count], float)
            triangles = np.asarray(model.mesh_face[start : start + faces])
        case kinds.mjGEOM_BOX:
            one = trimesh.creation.box(2 * size)
            vertices, triangles = np.asarray(one.vertices), np.asarray(one.faces)
        case kinds.mjGEOM_SPHERE:
            one = trimesh.creation.icosphere(2, size[0])
            vertices, triangles = np.asarray(one.vertices), np.asarray(one.faces)
        case kinds.mjGEOM_CAPSULE:
            one = trimesh.creation.capsule(2 * size[1], size[0], [16, 16])
            vertices, triangles = np.asarray(one.vertices) - [0, 0, one.bounds.mean(axis=0)[2]], np.asarray(one.faces)
        case kinds.mjGEOM_CYLINDER:
            one = trimesh.creation.cylinder(size[0], 2 * size[1], 24)
            vertices, triangles = np.asarray(one.vertices), np.asarray(one.faces)
        case _:
            return None
    R = np.empty(9)
    extra("robot_solids()", "mujoco").mju_quat2Mat(R, model.geom_quat[geom])
    return vertices @ R.reshape(3, 3).T + model.geom_pos[geom], triangles


def _colour(model: Any, geom: int) -> tuple[float, float, float]:
    material = int(model.geom_matid[geom])
    red, green, blue, _ = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    return float(red), float(green), float(blue)
