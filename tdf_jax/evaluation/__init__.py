"""Accuracy of weights and methods on cases with ground truth.

`tdf evaluate` measures the transfer of one pose (`pick_*`), `tdf benchmark` the imitation of a whole trajectory
(`path_*`). Both share the cases, the metrics, the statistics, the tables and the records.

Modules:
    annotated_meshes: real meshes with their sidecar
    axis_profiles: measured places of bowls and bottles
    baselines: principal axes and ICP
    cases: pairs of objects with a true pose
    clearance_study: colliding paths in random scenes, pushed clear
    conditions: complete, partial, sparse and noisy clouds
    confidence_study: reliability of the confidence of picks, and the fit of its curve
    depth_images: depth images of meshes on a table
    demonstration_count: picks from several demonstrations
    foreign_study: picks on clouds with foreign points, with and without their removal
    metrics: errors of poses and paths
    path_failures: failures at whole trajectories, and scenes of them
    path_methods: methods that imitate a whole trajectory
    path_report: page and record of `tdf benchmark`
    path_scores: attempts of every method on every task, and their errors
    path_tasks: tasks: a demonstration, a target, a goal, the ground truth
    pick_report: table, model card and record of `tdf evaluate`
    pick_transfer: one pose, transferred by a network and by baselines
    places: measured places of a mug
    recognition_study: recognition of objects of another category
    records: header of JSON records
    relation_report: page and record of `tdf benchmark --relations`
    relation_scores: placements of every method on every pair, and their verdicts
    relation_study: the touch by occupancies and the path to a target, measured at the truth
    relation_success: gap, penetration, orientation and support of a placed object
    relation_tasks: an object and a target that fit, the true placement, a demonstration
    scene: a demonstration and a target in one world
    sensitivity_study: derivatives of picks beside picks that are found again
    statistics: success thresholds and bootstrap intervals
    study_command: the command line that studies have in common
    tabletop: clouds of an object on a table, from depth images, and with foreign points
    tables: tables as Markdown and as text
    tracking_study: picks on objects that moved, tracked and found anew
    view_study: picks before and after a second view
"""
