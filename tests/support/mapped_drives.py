"""A simulated drive with the map that is built of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from hsloc.slam.mapper import Mapper
from hsloc.slam.parameters import GraphMapperParameters


def mapped(events: Any, parameters: Any = None, seed: int = 0) -> Any:
    mapper = Mapper(parameters or GraphMapperParameters(), np.random.default_rng(seed))
    said = [mapper.update(event) for event in events]
    return mapper.finish(), said
