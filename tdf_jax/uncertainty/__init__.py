"""The uncertainty of a pick.

Modules:
    advice: where to look from next
    calibration: confidence and recognition as logistic curves, their fit and their reliability
    covariance: curvature, covariance and free directions of a pose
    doubt: warnings of objects and targets of another category
    modes: distinct poses among the candidates
"""
