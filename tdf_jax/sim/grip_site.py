"""The site of the gripper's frame that a model lacks: the line that its author may add."""

from typing import Any

import numpy as np

from tdf_jax.sim.physics import extra

BEHIND = 0.01  # metres from the fingertips back to the middle of the pads


def site_hint(model: Any) -> str:
    """What to add to a model for the gripper's frame, in words.

    The hand is the body that all of the bodies at the ends share; the approach is the axis of the hand along which the
    fingers reach out, and they close along the axis on which they are apart.

    Args:
        model: the `mujoco.MjModel`.

    Returns:
        The line of MJCF and the name of the body that it belongs to; empty if there is no hand with fingers.
    """
    mujoco = extra("load_robot()", "mujoco")
    parents = [int(number) for number in model.body_parentid]
    ends = [body for body in range(1, model.nbody) if body not in parents[1:]]
    chains = [_ancestors(parents, body) for body in ends]
    shared = [body for body in chains[0] if all(body in chain for chain in chains)] if chains else []
    if len(ends) < 2 or not shared or not shared[0]:
        return ""
    hand, data = shared[0], mujoco.MjData(model)
    keys = [model.key(number).name for number in range(model.nkey)]
    if "home" in keys:
        mujoco.mj_resetDataKeyframe(model, data, keys.index("home"))
    mujoco.mj_kinematics(model, data)
    R, origin = data.xmat[hand].reshape(3, 3), data.xpos[hand]
    corners, fingers = [], {}
    for geom in range(model.ngeom):
        chain = _ancestors(parents, int(model.geom_bodyid[geom]))
        if hand not in chain[1:]:  # not of a finger
            continue
        box = model.geom_aabb[geom]
        local = box[:3] + box[3:] * np.stack(np.meshgrid(*[[-1, 1]] * 3), axis=-1).reshape(-1, 3)
        there = (data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T - origin) @ R
        corners.append(there)
        fingers.setdefault(chain[chain.index(hand) - 1], []).append(there.mean(axis=0))
    if len(fingers) < 2:
        return ""
    reach = np.concatenate(corners)
    ahead = int(np.argmax(np.abs(np.stack([reach.min(axis=0), reach.max(axis=0)])).max(axis=0)))
    sign = 1.0 if reach[:, ahead].max() > -reach[:, ahead].min() else -1.0
    apart = np.ptp([np.mean(one, axis=0) for one in fingers.values()], axis=0)
    apart[ahead] = -1.0
    approach, closing = sign * np.eye(3)[ahead], np.eye(3)[int(np.argmax(apart))]
    place = ((sign * reach[:, ahead]).max() - BEHIND) * approach
    axes = np.concatenate([np.cross(closing, approach), closing])
    words = "" if np.array_equal(axes, [1, 0, 0, 0, 1, 0]) else f' xyaxes="{_numbers(axes)}"'
    return f'<site name="grip" pos="{_numbers(np.round(place, 3))}"{words}/> in the body {model.body(hand).name!r}'


def _ancestors(parents: list[int], body: int) -> list[int]:
    chain = [body]
    while chain[-1]:
        chain.append(parents[chain[-1]])
    return chain


def _numbers(values) -> str:
    return " ".join(f"{value + 0.0:g}" for value in values)
