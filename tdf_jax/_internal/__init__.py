"""What every package uses and no user imports.

Modules:
    checks: validators of arguments
    deprecation: names of the release before
    devices: work shared among devices
    errors: the exception of a user's mistake, and warnings
    files: atomic writes; results kept between runs
    precision: full float32 products on every device
"""
