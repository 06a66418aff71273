"""What every package uses and no user imports.

Modules:
    boundary: settings of JAX, traced values and foreign arrays of callers
    cache: results kept by digest
    checks: validators of arguments
    compiled: compiled programs on disk
    deprecation: names of the release before
    devices: work shared among devices
    errors: the exception of a user's mistake, and warnings
    extras: modules of packages that an extra installs
    files: atomic writes
    precision: full float32 products on every device
    units: units of length
    version: the version of the library
    workers: processes that end with the run
"""
