"""Time and memory: `python -m bench` against PyTorch, `python -m bench.landscape` of landscapes alone."""
