"""WHERE AM I, on a known map."""
