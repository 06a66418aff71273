"""Timings of tdf_jax. Each file prints the machine, measures in one run, and is called by name: `python -m bench.landscape`."""
