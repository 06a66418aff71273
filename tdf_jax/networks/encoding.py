"""Encoding: from the point cloud of an object to its descriptor field."""

import functools
import warnings
from typing import Any, Literal, overload

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Real

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.deprecation import caller_level, renamed_keywords
from tdf_jax._internal.errors import ForeignPointsWarning, InputError, SizeWarning
from tdf_jax._internal.precision import full_precision
from tdf_jax._internal.units import CENTIMETRES, INCHES, MILLIMETRES
from tdf_jax.geometry import sampling
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.foreign import MOST, extent_of, find_foreign, remote_points
from tdf_jax.networks.model import Model, ModelInfo
from tdf_jax.networks.occupancy import condition, encode_latent

CENTRED = 1e-7  # share of a cloud's extent; a smaller mean is float32's rounding
PADDING = 250  # sizes of clouds of unknown density are padded to a multiple of this; common sizes are multiples
NUM_SUBSAMPLES = 8  # 16 subsamples raise the IoU by another 0.003
# Radians. Latents of subsamples of one mug are rotated against each other by 1 to 2 degrees, those of symmetric objects
# by 60 to 90 on average.
SAME_SIDE = np.pi / 6
# A cloud of one side of an object is up to two times smaller than the object, and an object in another orientation has
# another bounding box; a wrong unit is a factor of 39 or more.
SIZE_TOLERANCE = 3.0
# Points of a cloud that is judged by its field; fewer do not say how good the field is.
LEAST_JUDGED = 100
# Of the largest diagonal that the network knows: its fields of larger objects, such as racks, are less exact.
LARGEST = 0.8
# With inches, because the size of the training objects distinguishes them from centimetres.
PROBABLE_UNITS = (MILLIMETRES, CENTIMETRES, INCHES)


@overload
def encode(
    model: Model,
    points: Real[Array | np.ndarray, "points 3"],
    num_subsamples: int = NUM_SUBSAMPLES,
    *,
    clean: bool = True,
    return_kept: Literal[False] = False,
) -> DescriptorField: ...
@overload
def encode(
    model: Model,
    points: Real[Array | np.ndarray, "points 3"],
    num_subsamples: int = NUM_SUBSAMPLES,
    *,
    clean: bool = True,
    return_kept: Literal[True],
) -> tuple[DescriptorField, Bool[np.ndarray, " points"]]: ...
@public
@renamed_keywords(thinnings="num_subsamples")
def encode(
    model: Model,
    points: Real[Array | np.ndarray, "points 3"],
    num_subsamples: int = NUM_SUBSAMPLES,
    *,
    clean: bool = True,
    return_kept: bool = False,
) -> Any:
    """Encode an object's point cloud into its descriptor field.

    A network expects clouds of the density that it was trained on (`model.info.cloud_points`). `encode` therefore takes
    several farthest-point subsamples of a denser cloud, which are different samples of the surface, and averages their
    latents. It uses all points of a cloud that is no denser, and of every cloud if the density is unknown, as for
    converted weights. docs/results/training.md has the measurements.

    Foreign points are removed first, if they are at most 30 % of the cloud: points far from all else, and, with weights
    that know the density and the size of their training clouds, points that do not fit the field of the others. The
    field of a cloud without any is the same to the last bit as with `clean=False`. docs/guide/camera.md has examples.

    Args:
        model: network.
        points: point cloud of the object, (points, 3), metres, world frame; at least 21 points.
        num_subsamples: farthest-point subsamples to average, see `sampling.subsamples`; 0 uses all points.
        clean: remove foreign points. Points that are traced by `jax.jit` or `jax.vmap` are taken as they are.
        return_kept: also return which points were kept.

    Returns:
        The field, in the world frame; with `return_kept`, and a mask of the points that were kept, (points,). The field
        rotates and translates with the points, except for ties that rounding decides: in farthest-point sampling, and,
        if the network has a symmetry-breaking offset, in which point is the farthest from the centroid.

    Raises:
        InputError: the points are fewer than 21 or than the network's neighbours, not (points, 3), not finite, all
            equal, no measurements, or farther from the origin than float32 resolves; or `num_subsamples` is negative.

    Warns:
        ForeignPointsWarning: points near the object are removed; or more than 30 % of the points look foreign, and
            none is removed.
        SizeWarning: the cloud is far smaller or larger than the objects that the network was trained on.
    """
    if not isinstance(model, Model):
        raise InputError(f"encode(): model is {model!r}; expected a Model, such as tdf.load_model('mug')")
    cloud, density = checks.points("encode()", points), model.info.cloud_points
    num_subsamples = checks.count("encode()", "num_subsamples", num_subsamples, 0)
    checks.boolean("encode()", "clean", clean)
    checks.boolean("encode()", "return_kept", return_kept)
    if len(cloud) < model.config.neighbours:
        raise InputError(
            f"encode(): there are {len(cloud)} points; expected at least the network's "
            f"{model.config.neighbours} neighbours"
        )
    if checks.traced(cloud):
        shift = jnp.zeros_like(cloud[0])
        if num_subsamples and density is not None and len(cloud) > density:
            shift = jax.lax.stop_gradient(jnp.mean(cloud, axis=0))
            clouds = sampling.subsamples(cloud - shift, density, num_subsamples)
        else:
            clouds = cloud[None]
        field = _average(model.params, model.config, clouds, _anchor(cloud) - shift, shift)
        return (field, np.ones(len(cloud), bool)) if return_kept else field
    if checks.traced(model.params):
        return _encoded(model, cloud, num_subsamples, clean, return_kept)
    if not checks.tracing():
        return _encoded(model, cloud, num_subsamples, clean, return_kept)
    # A known cloud is encoded while a function that uses it is traced: whether its points are foreign is computed. Not
    # otherwise, because the context also evaluates every constant of the programs, one by one.
    with jax.ensure_compile_time_eval():
        return _encoded(model, cloud, num_subsamples, clean, return_kept)


def _encoded(model, cloud, num_subsamples, clean, return_kept):
    """`encode` of known points."""
    cloud = np.asarray(cloud)
    checks.near("encode()", "points", cloud)
    kept = _gathered(cloud, model.config.neighbours) if clean else np.ones(len(cloud), bool)
    cloud = cloud[kept]
    field = _field(model, cloud, num_subsamples, num_subsamples)
    if clean and _judges(model, cloud):
        fitting = find_foreign(
            field,
            cloud.astype(np.float64),
            # One subsample is enough to compare parts; it runs the same program.
            lambda part, exact: _field(model, cloud[part], num_subsamples if exact else 1, num_subsamples),
        )
        if fitting.field is not None:
            _warn_of_removed(int((~fitting.kept).sum()), len(cloud))
            field, kept[kept], cloud = fitting.field, fitting.kept, cloud[fitting.kept]
        elif not fitting.kept.all():
            _warn_of_foreign(int((~fitting.kept).sum()), len(cloud))
    _warn_of_size(model.info, cloud)
    return (field, kept) if return_kept else field


def _gathered(cloud, least: int) -> Bool[np.ndarray, " points"]:
    """Mask of the points that are not far from all else; of all if they would be too many."""
    remote = remote_points(cloud.astype(np.float64))
    number = int(remote.sum())
    if number > MOST * len(cloud) or len(cloud) - number < max(least, checks.MINIMUM_POINTS):
        _warn_of_foreign(number, len(cloud))
        return np.ones(len(cloud), bool)
    return ~remote


def _judges(model: Model, cloud) -> bool:
    """Whether a network's fields say which points are foreign: it was trained as `tdf train` does, on such sizes."""
    info = model.info
    if info.cloud_points is None or checks.traced(model.params):
        return False
    if info.smallest_diagonal is None or info.largest_diagonal is None:
        return False
    extent = extent_of(cloud.astype(np.float64))
    return len(cloud) >= LEAST_JUDGED and info.smallest_diagonal <= extent <= LARGEST * info.largest_diagonal


def _warn_of_removed(number: int, count: int) -> None:
    # Where what touches an object looks like a part of it, that part of the object itself may be what is removed.
    warnings.warn(
        f"encode(): {number} of {count} points are removed, because they do not fit the field of the others. If "
        "something of the same kind touches the object, they may be a part of the object itself: cut it out by a mask, "
        "or pass clean=False",
        ForeignPointsWarning,
        stacklevel=caller_level(),
    )


def _warn_of_foreign(number: int, count: int) -> None:
    warnings.warn(
        f"encode(): {number} of {count} points look as if they were not of the object, which is more than {MOST:.0%}; "
        "none of them is removed. Pass the cloud of one object, see tdf.separate_objects",
        ForeignPointsWarning,
        stacklevel=caller_level(),
    )


def _field(model: Model, cloud: np.ndarray, num_subsamples: int, slots: int) -> DescriptorField:
    """The field of a cloud as it is; `slots` is the number of subsamples that the program has room for."""
    density = model.info.cloud_points
    plain = num_subsamples == 0 or density is None
    count = len(cloud) if num_subsamples == 0 or density is None else density
    dense = len(cloud) > count
    whole, shift = _centred(cloud)
    # All subsamples share one anchor, so that they see the same side of a symmetric object as its front.
    anchor = _anchor(whole)
    clouds = sampling.subsamples(whole, count, num_subsamples) if dense else whole[None]
    if checks.traced(model.params):
        return _average(model.params, model.config, clouds, anchor, shift)
    num_clouds, size = clouds.shape[:2]
    # Padding with clouds and points that do not count lets clouds of many sizes run one program.
    padded = (1, -(-size // PADDING) * PADDING) if plain else (slots, count)
    clouds = np.resize(clouds, (*padded, 3))
    return _encode(model.params, model.config, clouds, np.int32(num_clouds), np.int32(size), anchor, shift)


def _centred(cloud):
    """The cloud relative to its mean, and the mean; the difference is taken in float64, before any rounding."""
    dtype = np.promote_types(jax.dtypes.canonicalize_dtype(cloud.dtype), np.float32)
    shift = cloud.mean(axis=0, dtype=np.float64)
    # See `_latent`: a cloud that counts as centred stays as it is.
    shift = np.where(np.abs(shift).max() <= CENTRED * np.ptp(cloud, axis=0).max(), 0.0, shift)
    return (cloud - shift).astype(dtype), shift.astype(dtype)


def _anchor(cloud):
    """The point that is the farthest from the mean."""
    return cloud[((cloud - cloud.mean(axis=0)) ** 2).sum(axis=1).argmax()]


def _sizes(info: ModelInfo) -> tuple[float, float]:
    """Diagonals between which a cloud's unit is not in doubt, metres; the network's sizes are known."""
    assert info.smallest_diagonal is not None and info.largest_diagonal is not None
    return info.smallest_diagonal / SIZE_TOLERANCE, info.largest_diagonal * SIZE_TOLERANCE


def _warn_of_size(info: ModelInfo, cloud: np.ndarray) -> None:
    """Warn if a cloud is so small or so large that its unit is probably wrong."""
    if info.smallest_diagonal is None or info.largest_diagonal is None:
        return
    diagonal = float(np.linalg.norm(np.ptp(cloud.astype(np.float64), axis=0)))
    least, most = _sizes(info)
    if least <= diagonal <= most:
        return
    # Centimetres and inches differ by less than the range of sizes: the unit that fits it best is the likely one.
    middle = np.sqrt(info.smallest_diagonal * info.largest_diagonal)
    name, metres, _ = min(PROBABLE_UNITS, key=lambda unit: abs(np.log(max(diagonal, 1e-30) * unit.metres / middle)))
    advice = "check its unit, and whether it holds the object alone"
    if least <= diagonal * metres <= most:
        advice = f"it is probably in {name}: multiply it by {metres:g}, or give --scale {metres:g}"
    warnings.warn(
        f"encode(): the bounding box of the cloud has a diagonal of {diagonal:.4g} m, and the weights {info.name!r} "
        f"were trained on objects of {info.smallest_diagonal:g} to {info.largest_diagonal:g} m; {advice}",
        SizeWarning,
        stacklevel=caller_level(),
    )


@functools.partial(jax.jit, static_argnames="config")
def _encode(params, config, clouds, num_clouds, size, anchor, shift):
    """The field averaged over the first `num_clouds` clouds, of their first `size` points; the rest is padding.

    Clouds and anchor are relative to `shift`, which is in the world frame.
    """
    used = jnp.arange(clouds.shape[1]) < size

    def fill(index, state):
        return jax.tree.map(
            lambda all, one: all.at[index].set(one), state, _latent(params, config, clouds[index], anchor, used)
        )

    def add(index, sums):
        return jax.tree.map(
            lambda sum, all: sum + jnp.where(consistent[index], all[index], 0), sums, (latents, origins)
        )

    dtype = jnp.result_type(clouds, *jax.tree.leaves(params))
    blank = jnp.zeros((len(clouds), config.latent, 3), dtype), jnp.zeros((len(clouds), 3), clouds.dtype)
    latents, origins = jax.lax.fori_loop(0, num_clouds, fill, blank)
    consistent = consistent_latents(latents, jnp.arange(len(clouds)) < num_clouds)
    sums = jax.lax.fori_loop(0, num_clouds, add, jax.tree.map(lambda all: jnp.zeros_like(all[0]), blank))
    latent, origin = (part / jnp.sum(consistent) for part in sums)
    return DescriptorField(condition(params, config, latent), origin + shift)


@functools.partial(jax.jit, static_argnames="config")
def _average(params, config, clouds, anchor, shift):
    """The same of all points of all clouds; its loops have known lengths, so it has a reverse-mode derivative."""
    latents, origins = jax.lax.map(lambda points: _latent(params, config, points, anchor), clouds)
    consistent = consistent_latents(jax.lax.stop_gradient(latents), jnp.ones(len(clouds), bool))
    latent, origin = (
        jnp.mean(all, axis=0, where=consistent[:, *[None] * (all.ndim - 1)]) for all in (latents, origins)
    )
    return DescriptorField(condition(params, config, latent), origin + shift)


@full_precision
def consistent_latents(
    latents: Float[Array, "subsamples latent 3"], used: Bool[Array, " subsamples"]
) -> Bool[Array, " subsamples"]:
    """Select latents that agree on one of the equivalent poses of a symmetric object.

    A symmetric object looks the same in several poses. Each subsample of it looks slightly more like one of these poses
    than like the others, and the network decides for that one: the two sides of a flat bottle change places, a round
    bottle is rotated about its axis. The mean of such latents represents none of the poses. Two latents are consistent
    if no rotation brings them nearer than half of their squared distance, or if the best rotation is smaller than
    `SAME_SIDE`. The function keeps the latents that are consistent with the one that has most others consistent with
    it; those are all latents of an object without symmetry.

    Args:
        latents: latents of subsamples of one cloud, (subsamples, latent, 3).
        used: mask of those that count, (subsamples,).

    Returns:
        Mask of the latents to average, (subsamples,).

    Source:
        The best rotation is Kabsch's, Acta Crystallographica A, 1976.
    """
    cross = jnp.einsum("aci,bcj->abij", latents, latents)
    u, values, v = jnp.linalg.svd(cross)
    sign = jnp.linalg.det(u) * jnp.linalg.det(v)
    proper = jnp.stack([jnp.ones_like(sign), jnp.ones_like(sign), sign], axis=-1)
    squares = jnp.sum(latents**2, axis=(1, 2))
    total = squares[:, None] + squares
    apart = total - 2 * jnp.trace(cross, axis1=-2, axis2=-1)
    aligned = total - 2 * jnp.sum(proper * values, axis=-1)
    cosine = (jnp.einsum("abik,abk,abki->ab", u, proper, v) - 1) / 2
    agree = ((apart <= 2 * aligned) | (cosine >= jnp.cos(SAME_SIDE))) & used & used[:, None]
    return agree[jnp.argmax(jnp.sum(agree, axis=1))]


def _latent(params, config, points, anchor, used=None):
    """Encode a cloud, or its used points, displaced away from `anchor` (world frame); return latent and origin."""
    origin = jnp.mean(points, axis=0, where=None if used is None else used[:, None])
    # A cloud that was centred in float32 keeps a mean of about 1e-9 m, and centring it again in float64 moves the
    # latent by 1e-6 of its length. Such a cloud counts as centred, so that parity with the original network, which
    # leaves centring to the caller, is exact.
    origin = jnp.where(jnp.max(jnp.abs(origin)) <= CENTRED * jnp.max(jnp.ptp(points, axis=0)), 0.0, origin)
    return encode_latent(params, config, points - origin, used, anchor - origin), origin
