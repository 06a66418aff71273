"""Training the occupancy network.

Modules:
    batch: samples of one step
    config: settings of a run
    dataset: labelled objects on disk
    labels: one labelled object
    loop: the training loop
    objective: what is minimised
    prefetch: batches drawn ahead
    run_folder: settings, metrics and checkpoint of a run
"""
