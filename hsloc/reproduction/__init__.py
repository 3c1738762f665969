"""The experiments of the papers, run again: E1 to E4 of [P] and the windows of Mirkhani et al. [M] (M1).

[P] "Harmonic Search Based Algorithms For Mobile Robot Localization" (course report).
[M] Mirkhani, Forsati, Shahri, Moayedikia, "A novel efficient algorithm for mobile robot localization", Robotics and
Autonomous Systems 61(9), 2013, 920-931.
"""

from hsloc.reproduction.material import Material, own_material, report_material
from hsloc.reproduction.run import EXPERIMENTS, Reproduction, reproduce

__all__ = ["EXPERIMENTS", "Material", "Reproduction", "own_material", "report_material", "reproduce"]
