"""Localisation on a known map."""
