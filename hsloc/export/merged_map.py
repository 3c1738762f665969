"""A merged map on disk: as a mapping run writes its map, with merge.json for where each map lies in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hsloc.atomic_write import whole_folder
from hsloc.dataclass_json import to_json
from hsloc.evaluation import write_json
from hsloc.maps import save_map
from hsloc.slam.map_state import STATE_FILE, write_state

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.replay.map_merge import MapMerge


def merge_summary(merge: MapMerge) -> dict[str, Any]:
    """The content of merge.json: verdict, where each map lies (m, rad), the loops that join it, the map's quality."""
    maps = [
        {"map": name, "x": pose.x, "y": pose.y, "yaw": pose.theta, "loops": joints}
        for name, pose, joints in zip(merge.names, merge.T_first_map, merge.joints, strict=True)
    ]
    return {**merge.mapping.evidence.to_dict(), "maps": maps, "mapping": to_json(merge.mapping.quality)}


def write_merged_map(merge: MapMerge, folder: Path) -> None:
    """Write map.yaml and map.pgm, map.npz to go on from, graph.g2o and merge.json. Raises OutputError."""
    state = merge.mapping.state
    with whole_folder(folder) as partial:
        save_map(merge.mapping.grid, partial)
        merge.mapping.graph.write_g2o(partial / "graph.g2o")
        if state is not None:
            write_state(state, partial / STATE_FILE)
        write_json(partial / "merge.json", merge_summary(merge))
