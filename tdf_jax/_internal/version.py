"""The version of the library, which the build, the records and the commands read here.

The metadata of an installation have it too, but those of an editable one keep the version that was installed.
"""

__version__ = "0.2.0"
