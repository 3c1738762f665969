"""Maps as nav2 reads and writes them: PGM and YAML."""
