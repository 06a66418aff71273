"""How good weights and methods are, on cases with ground truth.

Modules:
    annotated_meshes: real meshes with their sidecar
    axis_profiles: places of bowls and bottles, measured
    baselines: principal axes and ICP
    cases: pairs of objects with a true pose
    comparison: a network beside baselines
    conditions: complete, partial, sparse and noisy clouds
    clearance_study: colliding paths in random scenes, pushed clear
    demonstration_count: picks from several demonstrations
    methods: methods that imitate a whole trajectory
    metrics: errors of poses, paths and motions
    model_card: the card of weights
    path_page: the page of `tdf benchmark`
    path_runs: every method on every task, kept between runs
    path_scores: scores of whole trajectories
    path_tasks: tasks: a demonstration, a target, a goal, the truth
    pick_transfer: one pose transferred; reconstruction
    places: places of a mug, measured
    recognition_study: objects of another category, recognised by the match
    report: table and file of `tdf evaluate`
    scene: a demonstration and a target in one world
    statistics: medians, success rates, intervals
"""
