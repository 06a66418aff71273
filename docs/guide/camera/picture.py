"""Make the files of this folder: a rendered depth image of a mug beside a bottle with its camera, and scene.png.

The picture shows what is removed from the image's cloud, what is taken, and the pick.

Run it from the root of the repository: python docs/guide/camera/picture.py
"""

from pathlib import Path

import jax
import matplotlib
import numpy as np
from PIL import Image

import tdf_jax as tdf
from tdf_jax.evaluation.cases import QUERY_SIZE, generated_case, place_demonstration
from tdf_jax.geometry.query import box_query
from tdf_jax.perception.depth import flying_pixels
from tdf_jax.sim.bodies import body_of
from tdf_jax.sim.cameras import depth_image, look_at
from tdf_jax.sim.workcell import OBJECT, build_workcell
from tdf_jax.viz.style import CLOUD, COLOURS, STYLE, TRUTH, add_axes3d, blank_figure, legend_of, save_figure

FOLDER = Path(__file__).parent
SEED = 4
SHOWN = 4000  # points of each kind in the picture


def upright(shape, x, y, yaw):
    """Pose of an object on the table, 4x4."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = x, y, -shape.mesh.bounds[0, 2]
    return T


def seen():
    """The case, its camera, a noisy depth image with mixed pixels, and the mug's pixels."""
    case = generated_case("mug", SEED, 0, points=1500)
    mug, bottle = case.object_b, tdf.build_bottle()
    cell = build_workcell(
        None, body_of(mug), upright(mug, 0.5, -0.06, 0.6), body_of(bottle), upright(bottle, 0.5, 0.09, 0.0)
    )
    data = cell.data()
    camera = look_at((1.05, -0.05, 0.42), (0.5, 0.01, 0.06))
    fine = depth_image(cell.model, data, look_at((1.05, -0.05, 0.42), (0.5, 0.01, 0.06), width=1280, height=960))
    rays = np.stack([fine.depth[row::2, column::2] for row in (0, 1) for column in (0, 1)])
    noise = 0.001 * np.random.default_rng(SEED).normal(size=rays.shape[1:])
    depth = np.where((rays > 0).all(axis=0), rays.mean(axis=0) + noise, 0.0)
    return case, camera, depth, fine.mask(cell.model, OBJECT)[::2, ::2]


def some(points):
    """At most `SHOWN` points."""
    return points[np.random.default_rng(0).permutation(len(points))[:SHOWN]]


def main():
    """Write the picture."""
    case, camera, depth, mask = seen()
    T = camera.T_world_camera
    millimetres = np.round(1000 * depth).astype(np.uint16)
    Image.fromarray(millimetres).save(FOLDER / "depth.png")
    np.savetxt(FOLDER / "intrinsics.txt", camera.intrinsics, "%.4f")
    np.savetxt(FOLDER / "T_world_camera.txt", T, "%.9f")
    depth = 0.001 * millimetres
    points = tdf.points_from_depth(depth, camera.intrinsics, T)
    clouds = tdf.separate_objects(points, camera=T[:3, 3])
    demonstration = place_demonstration(case, "wave", 7, box_query(jax.random.key(1), 128, QUERY_SIZE))
    model = tdf.load_model("mug")
    picked, choice = tdf.pick_object(model, clouds, demonstration, return_choice=True)
    result = tdf.imitate(model, demonstration, picked, key=jax.random.key(0))
    print([len(cloud) for cloud in clouds], choice, float(result.confidence))

    metres = np.where(depth > 0, depth, np.nan)
    flying = flying_pixels(metres, camera.intrinsics)
    rows, columns = np.nonzero(flying)
    pixels = np.stack([columns, rows, np.ones(len(rows))], axis=1) @ np.linalg.inv(camera.intrinsics).T
    between = (pixels * depth[rows, columns][:, None]) @ T[:3, :3].T + T[:3, 3]
    names = {tuple(point) for cloud in clouds for point in cloud}
    table = points[[tuple(point) not in names for point in points]]

    with matplotlib.rc_context(STYLE):
        figure = blank_figure(7.4, 2.9)
        axes = figure.add_axes((0.01, 0.12, 0.32, 0.72))
        axes.imshow(metres, cmap="viridis_r")
        axes.contour(mask, [0.5], colors=TRUTH, linewidths=1.0)
        axes.set(title="depth image, the mug's mask", xticks=[], yticks=[])
        low, high = np.array([0.36, -0.17, -0.03]), np.array([0.66, 0.19, 0.27])
        kinds = (
            ("table", some(table), "#b9c0c7", 0.9),
            ("between surfaces", some(between), TRUTH, 0.8),
            ("other object", some(clouds[1 - choice.object]), "#7aa6c2", 0.5),
            ("taken", some(picked), COLOURS(0.35), 0.5),
        )
        legend = {}
        for left, title in ((0.335, "removed and taken"), (0.665, "the taken cloud and the pick")):
            axes = add_axes3d(figure, (left, 0.08, 0.33, 0.84))
            for label, cloud, colour, size in kinds if left < 0.5 else kinds[-1:]:
                inside = cloud[((cloud > low) & (cloud < high)).all(axis=1)]
                axes.scatter(*inside.T, s=size, color=colour, label=label, linewidths=0, depthshade=False)
            axes.set_title(title, y=0.99)
            if left > 0.5:
                low, high = picked.min(axis=0) - 0.02, picked.max(axis=0) + 0.02
                query = np.asarray(demonstration.query)
                pick = np.asarray(result.trajectory.matrices[0])
                box = query @ pick[:3, :3].T + pick[:3, 3]
                axes.scatter(*box.T, s=3, color=CLOUD, linewidths=0, label="query points at the pick")
                for column, colour in zip(pick[:3, :3].T, ("#d1495b", "#3a9d5d", "#2c6fbb")):
                    axes.plot(*np.stack([pick[:3, 3], pick[:3, 3] + 0.04 * column]).T, color=colour, lw=2)
                low, high = np.minimum(low, box.min(axis=0)), np.maximum(high, box.max(axis=0))
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
            axes.set_box_aspect(tuple(high - low), zoom=1.3)
            axes.view_init(elev=28, azim=-8)
            axes.set_axis_off()
            legend |= legend_of(axes)
        shown = figure.legend(legend.values(), legend.keys(), loc="lower center", ncols=5, frameon=False)
        for handle in shown.legend_handles:
            handle.set_sizes([12])
        save_figure(FOLDER / "scene.png", figure)


if __name__ == "__main__":
    main()
