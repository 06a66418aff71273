"""Full float32 precision of products, on every device."""

import functools

import jax


def chosen_precision() -> str | None:
    """The `jax.default_matmul_precision` that the caller has set, or None."""
    return jax.config.jax_default_matmul_precision  # pyright: ignore[reportAttributeAccessIssue]: added at run time


def full_precision(function):
    """Decorator of a function that is traced with full float32 precision of products.

    A `jax.default_matmul_precision` that the caller has set takes precedence. Accelerators round the factors of a
    product by default, which parity with the original network does not survive (docs/results/code_notes.md). Rotations
    are multiplied exactly whatever the caller has set (`se3.multiply`), because a rounded product is not a rotation.
    """

    @functools.wraps(function)
    def traced(*arguments, **options):
        with jax.default_matmul_precision(chosen_precision() or "highest"):
            return function(*arguments, **options)

    return traced
