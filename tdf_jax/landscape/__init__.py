"""The energy over a grid of positions (eq. 4 and 5 of the TDF paper).

Modules:
    energy_grid: `energy_landscape`, which sweeps the query frame over a grid
    shared_lattice: evaluations of the field that query points share
    shortest_path: `lowest_cost_path`
    storage: `Landscape`, and its file
"""
