"""Parametric object families with ground truth."""

from tdf_jax.shapes.mug import HANDLE_STYLES, Mug, MugParameters, build_mug, sample_mug, scaled

__all__ = ["HANDLE_STYLES", "Mug", "MugParameters", "build_mug", "sample_mug", "scaled"]
