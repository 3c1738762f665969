"""Figures that the papers print."""

from __future__ import annotations

E1 = {"HS": "visibly off", "HIDE": "on top of the scan"}
"""[P] Fig. 2, 3."""
E1_SECONDS = {"HS": 7.0, "HIDE": 19.0}
"""[P], MATLAB, 250 iterations."""

E2 = {"HS": "0.955 after 1000", "HIDE": "0.99 before 100"}
"""[P] Fig. 4."""

E3_RMSE = {"HS": (0.572, 0.886, 0.0386), "HIDE": (0.0447, 0.0623, 0.0351)}
"""[P] V: x, y in m, theta in rad, wrapped. [P] prints 0.467 and 0.362 rad: it did not wrap the difference, and one
pose on the other side of pi counts as 2 pi."""
E3_SECONDS = {"HS": 141.0, "HIDE": 576.0}
E3_PATH = (359.0, 119.8)
"""Metres and seconds."""

E4_RMSE = (0.223, 0.333, 0.0356)
"""[P] V, Fig. 8, by HS: x, y in m, theta in rad."""
E4_MAP = "complete but for a corner never seen"
"""[P] Fig. 7."""

M1_SUCCESS = {"HS": (0.97, 0.96), "HIDE": (0.96, 0.95)}
"""[M] Table 1: at 20 cm and at 30 cm."""
M1_ERROR = (0.0144, 0.11)
"""[M] Table 2: metres and degrees."""
M1_TIME = 0.89
"""[M]: HIDE needs 11 % fewer milliseconds than HS."""
M1_WANTED = 0.99
"""Ours: more than [M] has."""
