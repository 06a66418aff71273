"""Warnings where an object or a target is probably of another category than the demonstration's."""

import warnings

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal.deprecation import caller_level
from tdf_jax._internal.errors import CategoryWarning
from tdf_jax.networks.field import DescriptorField
from tdf_jax.uncertainty.calibration import ONE_NETWORK_CURVES, TARGET_CURVES, recognition, surface_logit

# Probability of the demonstration's category, or of a right pick, below which a warning is issued.
DOUBT = 0.5


def warn_of_category(function: str, what: str, recognised: float | None, weights: str, check: str) -> None:
    """Warn if an object is probably of another category than the demonstration's.

    Args:
        function: name that the message begins with.
        what: "object" or "target".
        recognised: probability that it is of the category; None where it is not known, which does not warn.
        weights: name of the weights.
        check: what the user may check, for the message.

    Warns:
        CategoryWarning: the probability is below `DOUBT`.
    """
    if recognised is not None and recognised < DOUBT:
        warnings.warn(
            f"{function}: the {what} does not look like one of the demonstration's category to the weights "
            f"{weights!r} (probability {recognised:.2g}); check {check}",
            CategoryWarning,
            stacklevel=caller_level(),
        )


def warn_of_target(
    function: str,
    residual: float,
    weights: str,
    field: DescriptorField | None,
    points: Float[Array | np.ndarray, "points 3"] | None,
) -> None:
    """Warn of a target of another category than the demonstration's, where that is known for the weights.

    Args:
        function: name that the message begins with.
        residual: residual of the contact pose on the target.
        weights: name of the weights.
        field: field of the target; None if it was not looked for there.
        points: cloud of the target, (points, 3), metres, world frame; None if the demonstrated target has not moved.

    Warns:
        CategoryWarning: the probability of the category is below `DOUBT`.
    """
    if weights not in TARGET_CURVES or field is None or points is None:
        return
    recognised = recognition(residual, surface_logit(field, jnp.asarray(points)), TARGET_CURVES[weights])
    warn_of_category(function, "target", recognised, weights, "target_points, their unit and target_model")


def warn_of_one_network(function: str, weights: str, target_logits: Float[np.ndarray, "2"]) -> None:
    """Warn of a demonstrated target that the weights of the object describe, and of whose category they are not.

    Args:
        function: name that the message begins with.
        weights: name of the object's weights.
        target_logits: mean logit and mean absolute logit at the target's points; infinite where they are not known or
            the target has weights of its own, see `tdf_jax.energy.reference.Contact`.

    Warns:
        CategoryWarning: the probability of the category is below `DOUBT`.
    """
    if weights not in ONE_NETWORK_CURVES or not np.isfinite(target_logits).all():
        return
    intercept, *slopes = ONE_NETWORK_CURVES[weights]
    recognised = float(1 / (1 + np.exp(-(intercept + np.dot(slopes, target_logits)))))
    if recognised < DOUBT:
        warnings.warn(
            f"{function}: the demonstrated target does not look like one of the category of the weights {weights!r}, "
            f"which describe it too (probability {recognised:.2g}); expected target_model (--target-weights), the "
            "weights of its category, see tdf.available_models()",
            CategoryWarning,
            stacklevel=caller_level(),
        )
