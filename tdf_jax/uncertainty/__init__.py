"""How sure a pick is.

Modules:
    calibration: confidence and recognition: logistic curves, their fit and reliability
    covariance: curvature, covariance and free directions of a pose
    modes: distinct solutions among the starts
"""
