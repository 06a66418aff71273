"""Whole trajectories transferred with known truth, by the library, by the paper's energy and by simple baselines."""
