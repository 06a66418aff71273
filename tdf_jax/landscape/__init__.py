"""The energy over a grid of positions (eq. 4 and 5).

Modules:
    energy_grid: `energy_landscape`
    shared_lattice: field evaluations that query points share
    shortest_path: `lowest_cost_path`
    storage: `Landscape`, and its file
"""
