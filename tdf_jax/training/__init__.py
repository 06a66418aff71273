"""Training of the occupancy network.

Modules:
    batch: samples of one step
    config: settings of a run
    dataset: labelled objects on disk
    labels: one labelled object
    loop: the training loop
    objective: the training loss
    prefetch: batches drawn before the steps that take them
    run_folder: settings, metrics and checkpoint of a run
"""
