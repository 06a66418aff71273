"""Products of float32 numbers as float32 products, on every device."""

import functools

import jax


def full_precision(function):
    """`function`, traced so that float32 products are float32 products, unless the caller has set `jax.default_matmul_precision`.

    By default accelerators round their factors: an H200 to 10 bits, which put the latents of the parity test off by
    1e-2, instead of the 1e-5 of a CPU. Rotations are multiplied exactly whatever the caller has set (`poses.multiply`):
    rounded, they are none.
    """

    @functools.wraps(function)
    def traced(*arguments, **options):
        with jax.default_matmul_precision(jax.config.jax_default_matmul_precision or "highest"):
            return function(*arguments, **options)

    return traced
