"""Time and memory: `python -m bench` against PyTorch, `bench.landscape` of landscapes, `bench.viewer` of `tdf view`."""
