"""Timings of tdf_jax, in one run and in turns: `python -m bench` against PyTorch, `python -m bench.landscape` against itself."""
