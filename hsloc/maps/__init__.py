"""Maps as nav2 reads and writes them: PGM and YAML."""

from hsloc.maps.map_file import LoadedMap, load_map, read_map, save_map

__all__ = ["LoadedMap", "load_map", "read_map", "save_map"]
