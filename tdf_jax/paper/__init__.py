"""The paper's settings, table and figures, as data.

Modules:
    energy_maps: figure 2: energy landscapes
    energy_study: energies that Gauss-Newton and Adam reach
    figures: figures 1, 3, 4 and 5
    runs: one run of a setting
    setting: what the paper varies
    store: runs kept by digest
    table: table 1
"""
