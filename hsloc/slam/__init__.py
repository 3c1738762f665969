"""WHERE AM I, while drawing the map."""
