"""A board at a height, the shelf of the tasks of NDF: its top is where bowls and bottles are placed."""

import dataclasses
import functools
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    import trimesh


@dataclasses.dataclass(frozen=True)
class Board:
    """A board on a block, upright, its origin in the middle of both.

    Attributes:
        size: width, depth and thickness of the board, metres.
        height: height of its top, metres.
        block: edge of the square block below, metres.
    """

    size: tuple[float, float, float] = (0.26, 0.26, 0.02)
    height: float = 0.12
    block: float = 0.08

    category = "board"

    @functools.cached_property
    def boxes(self) -> list[Float[np.ndarray, "8 3"]]:
        """Corners of the board and of the block, (8, 3) each, metres."""
        width, depth, thickness = self.size
        signs = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])).reshape(3, -1).T
        half = self.height / 2
        low = self.height - thickness
        board = signs * self.size + [0, 0, half - thickness / 2]
        block = signs * [self.block, self.block, low] + [0, 0, low / 2 - half]
        return [board, block]

    @functools.cached_property
    def mesh(self) -> "trimesh.Trimesh":
        """Its surface."""
        import trimesh

        parts = [trimesh.convex.convex_hull(corners) for corners in self.boxes]
        return trimesh.boolean.union(parts, engine="manifold")
