"""Cases of clouds, demonstrations and poses that a network computes with."""

import dataclasses

import numpy as np

from . import damage, undamaged as good
from .cases import ANY, DOUBT, ONLY_REFUSED, ONLY_RIGHT, Case, differs
from .files import not_finite, one_of
from .undamaged import CLOUD, World

# Lengths of a field's float32 numbers that rounding changes; permuted sums round otherwise.
ROUNDING = 2e-3


def _summary(world: World, field):
    """Descriptors of a field at a few places, and its origin."""
    import jax

    if "_values" not in world.__dict__:
        world.__dict__["_values"] = jax.jit(lambda field, x: field.descriptors(x))
    places = np.asarray(good.cloud(7, 10)) - np.asarray(good.cloud(3)).mean(axis=0) + np.asarray(field.origin)
    return np.asarray(world.__dict__["_values"](field, places.astype(np.float32)))


def hostile_cloud(rng, points):
    """A description, a cloud, and what is known: "same", "refused", "size" (a warning or a refusal), or None."""
    count = len(points)
    rows = rng.choice(count, int(rng.integers(2, 15)), replace=False)
    spoilt, sentinel = points.astype(float), points.astype(float)
    spoilt[rows[0], int(rng.integers(3))] = one_of(rng, [np.nan, np.inf])
    sentinel[rows] = one_of(rng, [[0, 0, 0], [-1, -1, -1]][: 2 if len(rows) > 2 else 1])
    options = {
        "permuted": (points[rng.permutation(count)], "same"),
        "not finite": (spoilt, "refused"), "a sentinel": (sentinel, "refused"), "transposed": (points.T, "refused"),
        "20 points": (points[:20], "refused"), "no points": (points[:0], "refused"),
        "all equal": (points * 0 + 1, "refused"),
        "all zero": (points * 0, "refused"), "millimetres": (points * 1000, "size"),
        "centimetres": (points * 100, "size"),
        "micrometres": (points * 1e6, "size"), "kilometres": (points / 1000, "size"),
        "huge": (points * np.float32(1e30), "size"),
        "tiny": (points.astype(float) * 1e-30, "size"), "squares that overflow": (points * np.float32(1e25), "size"),
        "map coordinates": (points + np.array([412345, 5412345, 120.0]), "refused"),
        "300 m away": (points + 300.0, "refused"),
        "map coordinates, float32": ((points + np.array([412345, 5412345, 120])).astype(np.float32), "refused"),
        "whole numbers": (np.round(points * 1000).astype(int), "size"),
        "half precision": (points.astype(np.float16), None),
        "in a plane": (points * [1, 1, 0], None), "on a line": (points * [1, 0, 0], None),
        "one point far away": (np.concatenate([points[:-1], [[90, 0, 0]]]), None),  # it is removed
        "quantised": (np.round(points / 0.01) * 0.01, None), "doubled": (np.repeat(points, 2, axis=0), None),
    }  # fmt: skip
    if rng.random() < 0.3:
        text, odd = damage.same_numbers(rng, points)
        return text, odd, "same"
    if rng.random() < 0.4:
        text, odd = damage.no_numbers(rng, points)
        return text, odd, "refused"
    text = one_of(rng, list(options))
    return text, *options[text]


EXPECTED = {"same": ONLY_RIGHT, "refused": ONLY_REFUSED, "size": DOUBT, None: ANY}


def encode_case(rng, world: World, folder) -> Case:
    """A hostile cloud for `encode`."""
    points = good.cloud(3)
    if rng.random() < 0.1:
        name, value = one_of(
            rng,
            [("num_subsamples", v) for v in (-1, 1.5, "8", None, True)] + [("model", v) for v in (None, "mug", 3, {})],
        )
        arguments = {"model": world.model, "points": points} | {name: value}
        return Case("encode", f"{name}={value!r}", lambda: world.tdf.encode(**arguments), expected=ONLY_REFUSED)
    text, cloud, known = hostile_cloud(rng, points)
    expected = _summary(world, world.field)

    def check(field):
        values = _summary(world, field)
        if known == "same":
            return differs(values, expected, ROUNDING)
        return not_finite([values, np.asarray(field.origin)])

    return Case("encode", text, lambda: world.tdf.encode(world.model, cloud), check, EXPECTED[known])


def describe_case(rng, world: World, folder) -> Case:
    """A hostile demonstration for `describe`."""
    tdf, demonstration = world.tdf, world.demonstration
    text, cloud, known = hostile_cloud(rng, CLOUD)
    if rng.random() < 0.3:
        other = dataclasses.replace(demonstration, query=demonstration.query + 1)
        few = dataclasses.replace(demonstration, release=1)
        value = one_of(
            rng, [[], None, 3, "demo", [None], [demonstration, 3], [demonstration, other], [demonstration, few], CLOUD]
        )
        return Case("describe", f"{value!r:.60}", lambda: tdf.describe(world.model, value), expected=ONLY_REFUSED)
    whole = np.asarray(world.reference.descriptors)

    def act():
        return tdf.describe(world.model, dataclasses.replace(demonstration, points=cloud))

    def check(reference):
        if known == "same":
            return differs(reference.descriptors, whole, ROUNDING)
        return not_finite(reference)

    return Case("describe", text, act, check, EXPECTED[known])


def _config(world: World):
    return world.tdf.CarryConfig(
        num_starts=8, num_coarse_queries=3, coarse_steps=2, prune_steps=2, refine_steps=3, polish_steps=6,
        num_candidates=3
    )  # fmt: skip


def imitate_case(rng, world: World, folder) -> Case:
    """A hostile cloud, goal or option for `imitate`."""
    import jax

    tdf, points = world.tdf, good.cloud(3)
    arguments = {
        "model": world.model, "demonstration": world.reference, "points": points, "key": jax.random.key(0),
        "config": _config(world),
    }  # fmt: skip
    goal = good.poses()[3]
    draw = rng.random()
    if draw < 0.4:
        text, cloud, known = hostile_cloud(rng, points)
        arguments["points"] = cloud
        expected = EXPECTED[known]
        if known == "same" and text not in {"permuted"}:
            if "_imitated" not in world.__dict__:
                world.__dict__["_imitated"] = np.asarray(
                    tdf.imitate(**(arguments | {"points": points})).trajectory.wxyz_xyz
                )
            whole = world.__dict__["_imitated"]
            check = lambda result: differs(result.trajectory.wxyz_xyz, whole, ROUNDING)  # noqa: E731
        else:
            # Points in another order round otherwise, and a random network has many picks that are nearly as good.
            check = _result_problem
    elif draw < 0.7:
        ros, first = goal[[4, 5, 6, 1, 2, 3, 0]], goal[[4, 5, 6, 0, 1, 2, 3]]
        options = {
            "ROS order": (ros, True), "positions first": (first, True), "norm 2": (goal * 2, True),
            "zeros": (goal * 0, True),
            "not finite": (goal * np.r_[1, 1, 1, 1, np.nan, 1, 1], True), "a matrix": (np.eye(4), True),
            "six numbers": (goal[:6], True),
            "far away": (goal + np.r_[0, 0, 0, 0, 1e5, 0, 0], True), "words": ("goal", True),
            "strings": (goal.astype(str), None),
            "millimetres": (goal * np.r_[1, 1, 1, 1, 2000, 2000, 2000], True), "a list": (goal.tolist(), False),
            "float64": (goal.astype(float), False), "a trajectory": (tdf.Trajectory(good.poses()), True),
            "objects": ([None] * 7, True),
            "negated": (goal * np.r_[-1, -1, -1, -1, 1, 1, 1], False), "two poses": (good.poses()[:2], True),
        }  # fmt: skip
        text, expected = "goal", ANY
        text = one_of(rng, list(options))
        arguments["goal"], refused = options[text]
        text, expected = f"goal: {text}", {True: ONLY_REFUSED, False: ONLY_RIGHT, None: ANY}[refused]

        def check(result):
            last = np.asarray(result.trajectory.wxyz_xyz)[-1]
            return differs(last * np.sign(last[:4] @ goal[:4]) ** np.r_[1, 1, 1, 1, 0, 0, 0], goal, 1e-4)
    else:
        options = [("goal_offset", v) for v in ([1, 2], "up", np.nan, [np.nan, 0, 0], {}, [[0, 0, 0]], 0.1)]
        options += [("key", v) for v in (0, None, "a", np.zeros(2), 1.5, jax.random.split(jax.random.key(0)))]
        options += [("config", v) for v in (None, "carry", {}, tdf.CarryConfig, 3)]
        options += [("demonstration", v) for v in (None, [], "demo.npz", CLOUD, 3)]
        options += [("model", v) for v in (None, "mug", {}, 3)]
        options += [
            ("energy", tdf.EnergyWeights()),
            ("fix_last", "no"),
            ("fix_last", None),
            ("device_mesh", 3),
        ]
        name, value = one_of(rng, options)
        arguments[name] = value
        text, expected, check = f"{name}={value!r:.40}", ONLY_REFUSED, lambda result: None
    return Case("imitate", text, lambda: tdf.imitate(**arguments), check, expected)


def _result_problem(result):
    return not_finite([np.asarray(result.trajectory.wxyz_xyz), np.asarray(result.energies)])


def field_case(rng, world: World, folder) -> Case:
    """A case of a network."""
    return one_of(rng, (encode_case, encode_case, describe_case, imitate_case))(rng, world, folder)
