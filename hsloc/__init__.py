"""hsloc: where was the robot? Offline localisation and mapping for recorded 2D-lidar logs.

Importing the package is cheap: the compiled kernels, SciPy and the readers are imported by the modules
that use them, so that `hsloc --help` answers at once.
"""

from hsloc.version import __version__

__all__ = ["__version__"]
